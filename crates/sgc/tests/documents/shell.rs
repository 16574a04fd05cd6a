//! Command lines of documents: those in code blocks, and words of one as a shell takes them.

use crate::markdown::{Block, Document};

/// Languages of blocks whose every line is a command.
const SHELLS: [&str; 3] = ["sh", "bash", "shell"];

/// Commands that run the command behind them.
const RUNNERS: [&str; 5] = ["sudo", "exec", "nohup", "time", "watch"];

/// A line of a document that a shell may run.
#[derive(Debug)]
pub(crate) struct CommandLine {
    pub(crate) line: usize,
    pub(crate) text: String,
    /// True for a line of a block, false for a code span, which may be a part of a command.
    pub(crate) is_whole: bool,
}

/// Returns the lines of shell blocks, the lines behind a prompt of other blocks, and all code spans.
pub(crate) fn command_lines(document: &Document) -> Vec<CommandLine> {
    let mut lines: Vec<_> = document.blocks().iter().flat_map(lines_of).collect();
    for paragraph in document.paragraphs() {
        let spans = paragraph.spans().into_iter();
        lines.extend(spans.map(|span| CommandLine { line: span.line, text: span.text, is_whole: false }));
    }
    lines
}

/// Returns the commands of a block, each on one line, without prompts.
fn lines_of(block: &Block) -> Vec<CommandLine> {
    let is_shell = SHELLS.contains(&block.language.as_str());
    let mut lines: Vec<CommandLine> = Vec::new();
    let mut continues = false;
    for (at, line) in block.code.lines().enumerate() {
        let text = without_prompt(line);
        let (text, goes_on) = text.strip_suffix('\\').map_or((text, false), |text| (text, true));
        match lines.last_mut().filter(|_| continues) {
            Some(last) => {
                last.text.push(' ');
                last.text.push_str(text);
            }
            None if is_shell || text.len() < line.len() => {
                lines.push(CommandLine { line: block.line + at, text: text.to_owned(), is_whole: true });
                continues = true;
            }
            None => {}
        }
        continues &= goes_on;
    }
    lines
}

/// Returns a line without `$ ` or `HOST$ ` in front, or without what makes it the command of a systemd unit.
fn without_prompt(line: &str) -> &str {
    if let Some(command) = line.strip_prefix("ExecStart=") {
        return command;
    }
    let Some((host, rest)) = line.split_once("$ ") else { return line };
    let is_prompt = host.chars().all(|c| c.is_ascii_alphanumeric() || "-_.@:~".contains(c));
    if is_prompt { rest.trim_start() } else { line }
}

/// Returns the words of each command of a line: of a pipeline, or of a list. Redirections and comments are left out,
/// and so are variables and `sudo` in front.
pub(crate) fn commands(line: &str) -> Vec<Vec<String>> {
    let (mut commands, mut words) = (Vec::new(), Vec::new());
    let (mut word, mut is_word, mut quote) = (String::new(), false, None);
    let mut chars = line.chars().chain([' ']).peekable();
    while let Some(c) = chars.next() {
        match (quote, c) {
            (Some(open), c) if c == open => quote = None,
            (Some(_), c) => word.push(c),
            (None, '\'' | '"') => (quote, is_word) = (Some(c), true),
            (None, '\\') => word.extend(chars.next()),
            (None, '#') if !is_word => break,
            (None, c) if c.is_whitespace() || "|&;<>()".contains(c) => {
                if is_word {
                    words.push(std::mem::take(&mut word));
                }
                is_word = false;
                match c {
                    '<' | '>' => {
                        // Its file is no word of the command.
                        while chars.next_if(|c| c.is_whitespace() || ">&<".contains(*c)).is_some() {}
                        while chars.next_if(|c| !c.is_whitespace() && !"|&;".contains(*c)).is_some() {}
                    }
                    c if c.is_whitespace() => {}
                    _ => commands.push(std::mem::take(&mut words)),
                }
            }
            (None, c) => {
                word.push(c);
                is_word = true;
            }
        }
    }
    commands.push(words);
    let is_setting = |word: &String| {
        let name = word.split_once('=').map(|(name, _)| name).unwrap_or_default();
        !name.is_empty() && name.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
    };
    let bare = |words: Vec<String>| -> Vec<String> {
        words.into_iter().skip_while(|word| is_setting(word) || RUNNERS.contains(&word.as_str())).collect()
    };
    commands.into_iter().map(bare).filter(|words| !words.is_empty()).collect()
}

#[test]
fn words_are_those_of_a_shell() {
    let words = |line| commands(line).iter().map(|words| words.join("|")).collect::<Vec<_>>();
    assert_eq!(words("sgc why '/a b' \"c\"  # d"), ["sgc|why|/a b|c"]);
    assert_eq!(
        words("A_B=c sudo sgc fleet ca > a.pem && make x; y | z 2>&1"),
        ["sgc|fleet|ca", "make|x", "y", "z|2"]
    );
    assert_eq!(
        words("sgc use 'arm-1:/**' --field ranges[0] a#b"),
        ["sgc|use|arm-1:/**|--field|ranges[0]|a#b"]
    );
}

#[test]
fn lines_are_joined_and_prompts_left_out() {
    let page = Document::new("a.md", "```sh\nlab$  a \\\n    b\nc\n```\n`d`\n```\n$ e\noutput\n```\n");
    let lines = command_lines(&page);
    let lines: Vec<_> = lines.iter().map(|line| (line.line, line.text.as_str(), line.is_whole)).collect();
    assert_eq!(lines, [(2, "a      b", true), (4, "c", true), (8, "e", true), (6, "d", false)]);
}
