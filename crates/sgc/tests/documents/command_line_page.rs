//! `docs/reference/command-line.md`: every command with its arguments, from the definition that the program parses
//! with.

use std::fmt::Write as _;

use clap::{Arg, ArgAction, Command};

use crate::generated::{self, wrapped};

const PAGE: &str = "docs/reference/command-line.md";

#[test]
fn the_page_of_the_command_line_is_what_the_program_takes() {
    generated::check(PAGE, &page(sgc::command_line()));
}

#[test]
fn commands_arguments_and_defaults_are_listed_and_what_is_hidden_is_not() {
    let mode = Arg::new("mode").long("mode").help("How").value_parser(["fast", "slow"]).default_value("slow");
    let file =
        Arg::new("file").value_name("FILE").required(true).help("A file <here>, see --mode [default: a.b]");
    let quiet = Arg::new("quiet").short('q').long("quiet").action(ArgAction::SetTrue).help("Say less");
    let secret = Arg::new("secret").long("secret").hide(true);
    let below = Command::new("do").about("Do it").args([mode, file, quiet, secret]);
    let program = Command::new("tool").about("A tool").subcommands([below, Command::new("not").hide(true)]);
    let page = page(program);
    for part in [
        "| [`tool do`](#tool-do) | Do it |",
        "\n## `tool do`\n\nDo it.\n\n```text\ntool do [OPTIONS] <FILE>\n```\n\n- `FILE`: A file `<here>`, see `--mode`. Default: a.b.\n",
        "- `--mode MODE`: How. Values: `fast`, `slow`. Default: `slow`.\n- `-q`, `--quiet`: Say less.\n",
    ] {
        assert!(page.contains(part), "{part}\nis not in\n{page}");
    }
    assert!(!page.contains("secret") && !page.contains("tool not"), "{page}");
}

/// Returns the page of a program.
fn page(mut program: Command) -> String {
    program.build();
    let mut page = generated::note("the definition of the command line");
    page.push_str("# Command line\n\n");
    page.push_str(&wrapped(
        "Every command of `sgc`, as `sgc COMMAND --help` shows it. A command exits with 0 if all is well, with 1 if it failed \
         while it ran, and with 2 if its arguments or the configuration cannot be right.",
        0,
    ));
    page.push('\n');
    page.push_str(&wrapped(
        "With `--json`, standard output has JSON alone: one document, or one in each line from a command that prints \
         several results. Errors and remarks are text on standard error.",
        0,
    ));
    page.push_str("\n| command | result |\n|---|---|\n");
    let commands = leaves(&program, program.get_name());
    for (name, command) in &commands {
        let about = command.get_about().map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(page, "| [`{name}`](#{}) | {} |", name.replace(' ', "-"), prose(&about));
    }
    let global: Vec<_> = program.get_arguments().filter(|arg| arg.is_global_set()).collect();
    if !global.is_empty() {
        page.push_str("\nEvery command takes these, too:\n\n");
        global.iter().for_each(|arg| page.push_str(&argument(arg)));
    }
    for (name, command) in &commands {
        let about =
            command.get_long_about().or(command.get_about()).map(ToString::to_string).unwrap_or_default();
        let _ = write!(page, "\n## `{name}`\n\n{}", paragraphs(&about));
        let usage = Command::clone(command).render_usage().to_string();
        let usage = usage.trim_start_matches("Usage: ").lines().map(str::trim).collect::<Vec<_>>().join("\n");
        let _ = write!(page, "\n```text\n{usage}\n```\n");
        let is_own = |arg: &&Arg| {
            let id = arg.get_id();
            !arg.is_global_set() && !arg.is_hide_set() && id != "help" && id != "version"
        };
        let own = command.get_arguments().filter(is_own);
        let (positional, flags): (Vec<&Arg>, Vec<&Arg>) = own.partition(|arg| arg.is_positional());
        if positional.len() + flags.len() > 0 {
            page.push('\n');
        }
        positional.iter().chain(&flags).for_each(|arg| page.push_str(&argument(arg)));
        if let Some(after) = command.get_after_help() {
            let _ = write!(page, "\n```text\n{}\n```\n", after.to_string().trim_end());
        }
    }
    page
}

/// Returns the commands that do something, with their whole names.
fn leaves<'c>(command: &'c Command, name: &str) -> Vec<(String, &'c Command)> {
    let shown = command.get_subcommands().filter(|below| !below.is_hide_set() && below.get_name() != "help");
    let below: Vec<_> =
        shown.flat_map(|below| leaves(below, &format!("{name} {}", below.get_name()))).collect();
    // `sgc router` runs a router, and has other commands below it.
    let is_leaf = below.is_empty() || command.is_subcommand_negates_reqs_set();
    let own = is_leaf.then(|| (name.to_owned(), command));
    own.into_iter().chain(below).collect()
}

/// Returns the line of an argument.
fn argument(arg: &Arg) -> String {
    let is_flag = !arg.get_action().takes_values();
    let names = arg.get_value_names().map(|names| names.iter().map(ToString::to_string).collect::<Vec<_>>());
    let names = names.unwrap_or_else(|| vec![arg.get_id().as_str().to_uppercase()]);
    let value = if is_flag { String::new() } else { names.join(" ") };
    let mut forms: Vec<_> = arg.get_short().map(|short| format!("`-{short}`")).into_iter().collect();
    let value = match arg.is_require_equals_set() {
        true if arg.get_num_args().is_some_and(|range| range.min_values() == 0) => format!("[={value}]"),
        true => format!("={value}"),
        false if value.is_empty() || arg.is_positional() => value,
        false => format!(" {value}"),
    };
    forms.extend(arg.get_long().map(|long| format!("`--{long}{value}`")));
    if arg.is_positional() {
        forms.push(format!("`{value}`"));
    }
    let help = arg.get_long_help().or(arg.get_help()).map(ToString::to_string).unwrap_or_default();
    let mut said = sentences(&help);
    let values: Vec<_> = arg.get_possible_values().into_iter().filter(|value| !value.is_hide_set()).collect();
    if !is_flag && !values.is_empty() {
        let values = values.iter().map(|value| match value.get_help() {
            Some(help) => format!("`{}` ({})", value.get_name(), prose(&help.to_string())),
            None => format!("`{}`", value.get_name()),
        });
        said.push_str(&format!(" Values: {}.", values.collect::<Vec<_>>().join(", ")));
    }
    if !is_flag && !arg.get_default_values().is_empty() && !arg.is_hide_default_value_set() {
        let defaults = arg.get_default_values().iter().map(|value| format!("`{}`", value.to_string_lossy()));
        said.push_str(&format!(" Default: {}.", defaults.collect::<Vec<_>>().join(", ")));
    }
    wrapped(&format!("- {}: {said}", forms.join(", ")), 2)
}

/// Returns help as wrapped paragraphs.
fn paragraphs(help: &str) -> String {
    let paragraphs = help.split("\n\n").filter(|text| !text.trim().is_empty());
    paragraphs.map(|text| wrapped(&sentences(text), 0)).collect::<Vec<_>>().join("\n")
}

/// Returns help on one line with a full stop.
fn sentences(help: &str) -> String {
    let text = prose(help);
    if text.is_empty() || text.ends_with(['.', '?', ':', ']']) { text } else { format!("{text}.") }
}

/// Returns help as Markdown has it: on one line, with flags, addresses and patterns as code, and notes in brackets as
/// sentences.
fn prose(help: &str) -> String {
    let mut is_code = false;
    let mark = |word: &str| {
        let was_code = is_code;
        is_code ^= word.matches('`').count() % 2 == 1;
        if was_code || word.contains('`') {
            return word.to_owned();
        }
        let core = word
            .trim_start_matches(['(', '[', '"'])
            .trim_end_matches(['.', ',', ';', ':', ')', ']', '?', '"']);
        let is_marked = core.len() > 2 && core.starts_with("--")
            || ["://", "*", "<"].iter().any(|part| core.contains(part));
        if is_marked { word.replacen(core, &format!("`{core}`"), 1) } else { word.to_owned() }
    };
    let mut text = help.split_whitespace().map(mark).collect::<Vec<_>>().join(" ");
    for (note, sentence) in [(" [default: ", ". Default: "), (" [env: ", ". Variable: ")] {
        if text.contains(note) && text.ends_with(']') {
            text = format!("{}.", text.trim_end_matches(']').replace(note, sentence));
        }
    }
    text.replace('|', "\\|")
}
