//! What callgrind wrote, as instructions by kind of code. Pure; of the format (`cl-format` in valgrind's manual) it
//! reads the costs that functions have by themselves, and leaves out who called whom.

use std::collections::HashMap;

use anyhow::{Context as _, Result, bail};
use serde::{Deserialize, Serialize};

/// Whose code an instruction is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Kind {
    /// Rust: ours, and the crates that are compiled into it.
    Rust,
    /// C and assembler in the program: AWS-LC, which chooses it by the processor.
    Cryptography,
    /// The C library, which chooses `memcpy` by the processor and `malloc` by its version.
    Libc,
}

/// Instructions by whose they are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Parts {
    /// Of Rust code.
    pub(crate) rust: u64,
    /// Of AWS-LC.
    pub(crate) cryptography: u64,
    /// Of the C library.
    pub(crate) libc: u64,
}

impl Parts {
    /// All of them.
    pub(crate) fn sum(self) -> u64 {
        self.rust + self.cryptography + self.libc
    }
}

/// What was counted.
#[derive(Debug, Default)]
pub(crate) struct Profile {
    counts: HashMap<Kind, u64>,
}

impl Profile {
    /// Reads a file of callgrind's. An error if it counts anything but instructions, or is none.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        let mut profile = Self::default();
        let (mut objects, mut functions) = (HashMap::new(), HashMap::new());
        let (mut object, mut function) = (String::new(), String::new());
        let (mut counts_instructions, mut is_of_call) = (false, false);
        for line in text.lines() {
            if let Some(events) = line.strip_prefix("events:") {
                if events.trim() != "Ir" {
                    bail!("it counts {events} and not instructions alone");
                }
                counts_instructions = true;
            } else if let Some(name) = line.strip_prefix("ob=") {
                object = resolve(name, &mut objects)?;
            } else if let Some(name) = line.strip_prefix("fn=") {
                function = resolve(name, &mut functions)?;
            } else if let Some(name) = line.strip_prefix("cob=") {
                resolve(name, &mut objects)?;
            } else if let Some(name) = line.strip_prefix("cfn=") {
                resolve(name, &mut functions)?;
            } else if line.starts_with("calls=") {
                is_of_call = true;
            } else if line.starts_with(|c: char| c.is_ascii_digit() || "+-*".contains(c)) {
                // The line behind a call is what was called, which is counted where it stands itself.
                if std::mem::take(&mut is_of_call) {
                    continue;
                }
                let cost = line.split_whitespace().nth(1).unwrap_or("0");
                let cost: u64 = cost.parse().with_context(|| format!("no cost: {line}"))?;
                *profile.counts.entry(kind(&object, &function)).or_default() += cost;
            }
        }
        if !counts_instructions {
            bail!("this is no profile of callgrind's");
        }
        Ok(profile)
    }

    /// All instructions.
    pub(crate) fn sum(&self) -> u64 {
        self.counts.values().sum()
    }

    /// By whose they are, for one of so many times.
    pub(crate) fn parts(&self, times: u64) -> Parts {
        let of = |kind| self.counts.get(&kind).copied().unwrap_or(0).div_ceil(times.max(1));
        Parts { rust: of(Kind::Rust), cryptography: of(Kind::Cryptography), libc: of(Kind::Libc) }
    }
}

/// `(7) name` says what 7 is, `(7)` means it.
fn resolve(text: &str, names: &mut HashMap<u32, String>) -> Result<String> {
    let (number, name) = text
        .strip_prefix('(')
        .and_then(|rest| rest.split_once(')'))
        .with_context(|| format!("no compressed name: {text}"))?;
    let number = number.parse().with_context(|| format!("no number of a name: {text}"))?;
    match name.trim() {
        "" => names.get(&number).cloned().with_context(|| format!("a name that was not said: {text}")),
        name => {
            names.insert(number, name.to_owned());
            Ok(name.to_owned())
        }
    }
}

fn kind(object: &str, function: &str) -> Kind {
    let file = object.rsplit('/').next().unwrap_or_default();
    if ["libc.so", "libc-", "libm.so", "ld-linux", "libgcc_s", "libpthread"]
        .iter()
        .any(|l| file.starts_with(l))
    {
        return Kind::Libc;
    }
    // Symbols of the C library that were not resolved yet stand under the loader's or the program's own name.
    if function.starts_with("mem") || matches!(function, "malloc" | "free" | "calloc" | "realloc") {
        return Kind::Libc;
    }
    // Paths have colons in Rust and nothing else here; what the compiler made up (`_R…`, `core::…`) is Rust as well.
    let is_rust = function.contains("::") || function.starts_with("_R") || function.starts_with("__rust");
    if is_rust { Kind::Rust } else { Kind::Cryptography }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "version: 1\npositions: line\nevents: Ir\n\n\
        ob=(1) /x/hot\nfl=(1) ???\nfn=(1) sgc_wire::packet::read::h0123\n0 100\n+3 20\n\
        cob=(2) /lib/libc.so.6\ncfi=(2) ???\ncfn=(2) __memcpy_avx\ncalls=2 0\n* 5000\n- 7\n\n\
        fn=(3) aws_lc_0_41_0_gcm_ghash\n0 400\n\nob=(2)\nfn=(2)\n0 60\n\nob=(1)\nfn=(1)\n0 3\n";

    #[test]
    fn each_cost_is_counted_once_and_where_it_stands() {
        let profile = Profile::parse(TEXT).unwrap();
        assert_eq!(profile.sum(), 590);
        assert_eq!(profile.parts(10), Parts { rust: 13, cryptography: 40, libc: 6 });
    }

    #[test]
    fn what_is_no_profile_is_an_error() {
        assert!(Profile::parse("").is_err());
        assert!(Profile::parse("events: Ir Dr\n").is_err());
        assert!(Profile::parse("events: Ir\nfn=(4)\n").is_err());
    }
}
