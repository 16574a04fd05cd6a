//! Command lines of `sgc` parse with the definition that the program parses with.
//!
//! A line of a code block must be a whole command. A code span may leave arguments out: it may name no more than a
//! command, and an `…` in it stands for anything.

use std::collections::BTreeSet;
use std::sync::LazyLock;

use clap::Command;
use clap::error::{ContextKind, ContextValue, ErrorKind};

use crate::markdown::Document;
use crate::report::Report;
use crate::repository::REPOSITORY;
use crate::shell;

/// The last word of strings that keys are derived with and signatures are made over, such as "sgc join v1". They are no
/// command lines.
const OF_CRYPTOGRAPHY: &str = "v1";

/// The flags that sources name, of whatever program.
static FLAGS: LazyLock<BTreeSet<String>> = LazyLock::new(|| {
    let mut flags = BTreeSet::new();
    for path in REPOSITORY.sources() {
        let text = REPOSITORY.read(path);
        let names =
            text.split("--").skip(1).map(|rest| rest.split(|c: char| !c.is_ascii_lowercase() && c != '-'));
        flags.extend(names.filter_map(|mut name| Some(format!("--{}", name.next()?))));
    }
    flags
});

#[test]
fn every_cited_command_line_parses() {
    let mut report = Report::default();
    for document in REPOSITORY.documents() {
        check(&document, &mut report);
    }
    report.finish(100, "`sgc` does not take these command lines:");
}

fn check(document: &Document, report: &mut Report) {
    for line in shell::command_lines(document) {
        for words in shell::commands(&line.text) {
            let is_sgc = words.first().is_some_and(|word| word == "sgc" || word.ends_with("/sgc"));
            if !is_sgc || words.last().is_some_and(|word| word == OF_CRYPTOGRAPHY) {
                continue;
            }
            let outcome = match words.iter().any(|word| word.contains('…')) {
                true => check_flags(&words),
                false => parse(&words, line.is_whole),
            };
            report.check(
                &document.path,
                line.line,
                outcome.map_err(|fault| format!("`{}`: {fault}", line.text)),
            );
        }
    }
    check_flags_alone(document, report);
}

/// Parses a command line as the program does.
fn parse(words: &[String], is_whole: bool) -> Result<(), String> {
    if let Some(hidden) = hidden(words) {
        return Err(format!("{hidden} is hidden: it has another name now, or is none of the user's"));
    }
    let Err(error) = sgc::command_line().try_get_matches_from(words) else { return Ok(()) };
    // A placeholder is no valid value.
    let has_placeholder = words.iter().any(|word| is_placeholder(word));
    let lacks_value = !is_whole && words.last().is_some_and(|word| word.starts_with('-'));
    let is_fine = match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => true,
        ErrorKind::InvalidSubcommand => matches!(
            error.get(ContextKind::InvalidSubcommand),
            Some(ContextValue::String(word)) if is_placeholder(word)
        ),
        ErrorKind::InvalidValue if lacks_value => true,
        ErrorKind::InvalidValue | ErrorKind::ValueValidation => has_placeholder,
        ErrorKind::MissingRequiredArgument
        | ErrorKind::MissingSubcommand
        | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => !is_whole,
        _ => false,
    };
    if is_fine { Ok(()) } else { Err(error.to_string().lines().next().unwrap_or_default().to_owned()) }
}

/// Returns a word that names a hidden command or flag. The program takes those under their earlier names, to name the
/// present ones.
fn hidden(words: &[String]) -> Option<&str> {
    let program = program();
    let mut command = &program;
    for word in words.iter().skip(1) {
        if let Some(found) = command.find_subcommand(word) {
            if found.is_hide_set() {
                return Some(word);
            }
            command = found;
        }
        let flag = word.strip_prefix("--").and_then(|flag| flag.split('=').next());
        let is_meant = |arg: &&clap::Arg| arg.is_hide_set() && arg.get_long() == flag;
        if flag.is_some() && command.get_arguments().any(|arg| is_meant(&arg)) {
            return Some(word);
        }
    }
    None
}

/// Returns the definition with the flags that every command has.
fn program() -> Command {
    let mut program = sgc::command_line();
    program.build();
    program
}

fn is_placeholder(word: &str) -> bool {
    word.len() > 1 && word.chars().all(|c| c.is_ascii_uppercase())
}

/// Looks for the command that words begin with, and for their flags there or in a command below it.
fn check_flags(words: &[String]) -> Result<(), String> {
    let program = program();
    let mut command = &program;
    for word in words.iter().skip(1).take_while(|word| is_command(word)) {
        let Some(found) = command.find_subcommand(word) else {
            // The name of a topic, a node or a file may stand here.
            if command.has_subcommands() {
                return Err(format!("{} has no command {word}", command.get_name()));
            }
            break;
        };
        command = found;
    }
    let flags = words.iter().filter(|word| word.starts_with("--"));
    let missing =
        flags.map(|flag| flag.split('=').next().unwrap_or(flag)).find(|flag| !has_flag(command, flag));
    missing.map_or(Ok(()), |flag| Err(format!("{} has no {flag}", command.get_name())))
}

fn is_command(word: &str) -> bool {
    !word.starts_with('-') && word.chars().all(|c| c.is_ascii_lowercase() || c == '-')
}

/// Returns `true` if a command, or one below it, has a flag.
fn has_flag(command: &Command, flag: &str) -> bool {
    let name = flag.trim_start_matches('-');
    let is_own = command.get_arguments().any(|arg| {
        arg.get_long() == Some(name) || arg.get_all_aliases().is_some_and(|all| all.contains(&name))
    });
    is_own || command.get_subcommands().any(|below| has_flag(below, flag))
}

/// A flag that is said to be one "of" a command is, and a flag beside a command is known to some program here.
fn check_flags_alone(document: &Document, report: &mut Report) {
    for paragraph in document.paragraphs() {
        let spans = paragraph.spans();
        let is_beside = spans.iter().any(|span| span.text.starts_with("sgc "));
        for (at, flag) in spans.iter().enumerate().filter(|(_, span)| is_beside && is_flag(&span.text)) {
            let name = flag.text.split([' ', '=']).next().unwrap_or_default();
            let next = spans.get(at + 1).filter(|next| next.text.starts_with("sgc "));
            let of = next.filter(|next| paragraph.text[flag.place.end..next.place.start].trim() == "of");
            let outcome = match of {
                Some(command) => {
                    let words = command.text.split_whitespace().chain([name]).map(str::to_owned);
                    check_flags(&words.collect::<Vec<_>>())
                }
                None if has_flag(&program(), name) || FLAGS.contains(name) => Ok(()),
                None => Err(format!("no command has {name}")),
            };
            report.check(&document.path, flag.line, outcome);
        }
    }
}

/// Returns `true` for a flag by its long name.
fn is_flag(text: &str) -> bool {
    text.strip_prefix("--").is_some_and(|name| name.starts_with(|c: char| c.is_ascii_lowercase()))
}

#[test]
fn a_wrong_command_line_is_found_in_each_form() {
    let faults = |text: &str| Report::faults_of(|report| check(&Document::new("page.md", text), report));
    for right in [
        "`sgc`, `sgc why`, `sgc fleet`, `sgc fleet revoke`, `sgc why --name HEX`, `sgc fleet … --at`, `sgc run --identity`, `sgc use …`",
        "`sgc run --help`, `sgc COMMAND --help`, `/usr/bin/sgc why`, `--at NODE` of `sgc fleet revoke`, `sgc fleet … --allow-core-dumps`, `--force`, `--nocapture`, `sgc join v1`, `sgc audit --since TIME`",
        "```sh\nlab$ sgc fleet create lab  # one\nsgc run --identity a.identity --router quic://a:1 \\\n  --use 'b:/**' > log\n```",
        "```\nsgc nothing\nsgc: an error\n```\n\n```toml\n# sgc nothing\n```",
    ] {
        assert_eq!(faults(right), "", "{right}");
    }
    for (wrong, said) in [
        ("`sgc fly`", "page.md:1: `sgc fly`: error: unrecognized subcommand 'fly'"),
        ("`sgc fleet rewoke arm-1`", "unrecognized subcommand 'rewoke'"),
        ("`sgc why /a --no-such`", "unexpected argument '--no-such'"),
        ("`sgc status\nmore`", "unexpected argument 'more'"),
        ("`sgc fleet … --fly`", "fleet has no --fly"),
        ("`sgc flet … --at`", "sgc has no command flet"),
        ("`--fly` of `sgc run`", "run has no --fly"),
        (
            "```sh\ncd x && sgc why\n```",
            "page.md:2: `cd x && sgc why`: error: the following required arguments",
        ),
        ("```ini\nExecStart=/usr/bin/sgc fly\n```", "unrecognized subcommand 'fly'"),
        ("```\n$ sgc fly\n```", "unrecognized subcommand 'fly'"),
    ] {
        assert!(faults(wrong).contains(said), "{wrong}: {}", faults(wrong));
    }
}
