//! Markdown, as far as citations need it: paragraphs, code spans, code blocks, links and headings.
//!
//! Rendering is not judged here.

use std::ops::Range;

/// The beginnings of items of a list.
const LIST_MARKS: [&str; 2] = ["- ", "* "];

/// A page.
#[derive(Debug)]
pub(crate) struct Document {
    /// The path from the root of the repository.
    pub(crate) path: String,
    text: String,
}

/// Lines of prose that belong together; a row of a table is one by itself.
#[derive(Debug)]
pub(crate) struct Paragraph {
    /// The number of the first line, from 1.
    line: usize,
    pub(crate) text: String,
}

/// Text between backticks.
#[derive(Debug)]
pub(crate) struct Span {
    pub(crate) line: usize,
    pub(crate) text: String,
    /// The place in the paragraph, backticks included.
    pub(crate) place: Range<usize>,
}

/// A fenced code block.
#[derive(Debug)]
pub(crate) struct Block {
    /// The number of its first line of code.
    pub(crate) line: usize,
    pub(crate) language: String,
    pub(crate) code: String,
}

/// A link to a file, or to a heading.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Link {
    pub(crate) line: usize,
    pub(crate) target: String,
}

impl Document {
    /// A page with this text.
    pub(crate) fn new(path: &str, text: &str) -> Self {
        Self { path: path.to_owned(), text: text.to_owned() }
    }

    /// Returns `true` if the page has this line.
    pub(crate) fn has_line(&self, line: &str) -> bool {
        self.text.lines().any(|found| found == line)
    }

    /// Returns the prose, without code blocks.
    pub(crate) fn paragraphs(&self) -> Vec<Paragraph> {
        let mut paragraphs: Vec<Paragraph> = Vec::new();
        let mut is_open = false;
        for (line, text) in self.prose() {
            let is_whole = text.is_empty() || text.starts_with(['|', '#']);
            let begins = is_whole || LIST_MARKS.iter().any(|mark| text.trim_start().starts_with(mark));
            match paragraphs.last_mut().filter(|_| is_open && !begins) {
                Some(paragraph) => {
                    paragraph.text.push('\n');
                    paragraph.text.push_str(text);
                }
                None => paragraphs.push(Paragraph { line, text: text.to_owned() }),
            }
            is_open = !is_whole;
        }
        paragraphs
    }

    /// Returns the code blocks.
    pub(crate) fn blocks(&self) -> Vec<Block> {
        let mut blocks: Vec<Block> = Vec::new();
        let mut fence: Option<&str> = None;
        for (line, text) in self.numbered() {
            match (fence, fence_of(text)) {
                (None, Some(mark)) => {
                    let language = text.trim().trim_start_matches(['`', '~']).trim().to_owned();
                    blocks.push(Block { line: line + 1, language, code: String::new() });
                    fence = Some(mark);
                }
                (Some(open), Some(mark)) if mark.starts_with(open) => fence = None,
                (Some(_), _) => {
                    if let Some(block) = blocks.last_mut() {
                        block.code.push_str(text);
                        block.code.push('\n');
                    }
                }
                (None, None) => {}
            }
        }
        blocks
    }

    /// Returns the targets within this repository of all links.
    pub(crate) fn links(&self) -> Vec<Link> {
        let mut links = Vec::new();
        for paragraph in self.paragraphs() {
            let mut text = paragraph.text.clone();
            // Code contains no links. Bytes keep their places.
            for span in paragraph.spans() {
                text.replace_range(span.place.clone(), &"`".repeat(span.place.len()));
            }
            let inline = text.match_indices("](").map(|(at, _)| at + 2);
            let reference = text.match_indices("]: ").filter(|(at, _)| {
                let line = text[..*at].rsplit('\n').next().unwrap_or_default();
                line.starts_with('[') && !line.contains(']')
            });
            for at in inline.chain(reference.map(|(at, _)| at + 3)) {
                let target = text[at..].split([')', ' ', '\n']).next().unwrap_or_default();
                let target = target.trim_matches(['<', '>']);
                if !target.contains("://") && !target.starts_with("mailto:") {
                    links.push(Link { line: paragraph.line_at(at), target: target.to_owned() });
                }
            }
        }
        links
    }

    /// Returns the anchors of all headings, as GitHub and mdBook make them.
    pub(crate) fn anchors(&self) -> Vec<String> {
        let mut anchors: Vec<String> = Vec::new();
        for (_, line) in self.prose() {
            if line.starts_with('#') {
                let heading = line.trim_start_matches('#').trim().to_lowercase();
                let kept = heading.chars().filter(|c| c.is_alphanumeric() || matches!(c, '-' | '_' | ' '));
                let anchor: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
                let before = anchors.iter().filter(|other| {
                    let number = other.strip_prefix(&anchor).and_then(|rest| rest.strip_prefix('-'));
                    **other == anchor || number.is_some_and(|n| n.parse::<usize>().is_ok())
                });
                let before = before.count();
                anchors.push(if before == 0 { anchor } else { format!("{anchor}-{before}") });
            }
            for attribute in ["id=\"", "name=\""] {
                let ids = line.split(attribute).skip(1).filter_map(|rest| rest.split('"').next());
                anchors.extend(ids.map(str::to_owned));
            }
        }
        anchors
    }

    /// Returns the lines outside of code blocks, with their numbers.
    fn prose(&self) -> impl Iterator<Item = (usize, &str)> {
        let mut fence: Option<&str> = None;
        self.numbered().filter(move |(_, text)| {
            let mark = fence_of(text);
            match (fence, mark) {
                (None, Some(mark)) => fence = Some(mark),
                (Some(open), Some(mark)) if mark.starts_with(open) => fence = None,
                (None, None) => return true,
                (Some(_), _) => {}
            }
            false
        })
    }

    fn numbered(&self) -> impl Iterator<Item = (usize, &str)> {
        self.text.lines().enumerate().map(|(at, text)| (at + 1, text))
    }
}

/// Returns the mark of a line that begins or ends a code block.
fn fence_of(line: &str) -> Option<&str> {
    let line = line.trim_start();
    let length = ['`', '~'].map(|c| line.len() - line.trim_start_matches(c).len()).into_iter().max()?;
    line.get(..length).filter(|mark| mark.len() >= 3)
}

impl Paragraph {
    /// Returns the code spans.
    pub(crate) fn spans(&self) -> Vec<Span> {
        let (mut spans, mut from) = (Vec::new(), 0);
        while let Some(start) = self.text[from..].find('`').map(|at| from + at) {
            let run = |text: &str| text.len() - text.trim_start_matches('`').len();
            let length = run(&self.text[start..]);
            let mut end = start + length;
            // The end is as long a run as the beginning.
            let close = loop {
                let Some(at) = self.text[end..].find('`').map(|at| end + at) else { break None };
                let found = run(&self.text[at..]);
                end = at + found;
                if found == length {
                    break Some(at);
                }
            };
            let Some(close) = close else {
                from = start + length;
                continue;
            };
            let text = self.text[start + length..close].lines().map(str::trim).collect::<Vec<_>>().join(" ");
            spans.push(Span { line: self.line_at(start), text, place: start..end });
            from = end;
        }
        spans
    }

    /// Returns the number of the line at a place.
    pub(crate) fn line_at(&self, place: usize) -> usize {
        self.line + self.text[..place].matches('\n').count()
    }

    /// Returns the text behind a span.
    pub(crate) fn behind(&self, span: &Span) -> &str {
        &self.text[span.place.end..]
    }

    /// Returns the text in front of a span.
    pub(crate) fn before(&self, span: &Span) -> &str {
        &self.text[..span.place.start]
    }

    /// Returns the cells of a row of a table.
    pub(crate) fn cells(&self) -> Option<Vec<Paragraph>> {
        let row = self.text.strip_prefix('|')?.trim_end().trim_end_matches('|');
        let cell = |text: &str| Paragraph { line: self.line, text: text.trim().to_owned() };
        Some(row.split('|').map(cell).collect())
    }

    /// Returns the number of the first line.
    pub(crate) fn line(&self) -> usize {
        self.line
    }
}

#[test]
fn spans_are_found_over_lines_and_in_longer_fences() {
    let page = Document::new(
        "a.md",
        "One `a\nb` and ``c ` d``.\n\n| `e` | `f` |\n\n```sh\n`no`\n```\n- `g` alone ` here\n- `h`\n",
    );
    let found: Vec<_> =
        page.paragraphs().iter().flat_map(Paragraph::spans).map(|s| (s.line, s.text)).collect();
    let expected = [(1, "a b"), (2, "c ` d"), (4, "e"), (4, "f"), (9, "g"), (10, "h")];
    assert_eq!(found, expected.map(|(line, text)| (line, text.to_owned())));
    assert_eq!(page.blocks().iter().map(|b| (b.line, b.code.as_str())).collect::<Vec<_>>(), [(7, "`no`\n")]);
}

#[test]
fn links_in_prose_are_found_and_those_in_code_are_not() {
    let text = "[a](b.md#c), ![d](e.svg \"f\"), [g](https://h), `[i](j.md)`, [k\nl](m.md)\n\n[n]: o.md\n";
    let links = Document::new("a.md", text).links();
    let found: Vec<_> = links.iter().map(|link| (link.line, link.target.as_str())).collect();
    assert_eq!(found, [(1, "b.md#c"), (1, "e.svg"), (2, "m.md"), (4, "o.md")]);
}

#[test]
fn headings_have_the_anchors_that_github_gives_them() {
    let page =
        Document::new("a.md", "# `sgc run`: a/b\n## Twice\n## Twice\n```\n# no\n```\n<a id=\"x\"></a>\n");
    assert_eq!(page.anchors(), ["sgc-run-ab", "twice", "twice-1", "x"]);
}
