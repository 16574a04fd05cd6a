//! Parses callgrind's output to instructions by kind of code. Pure. It reads only the self costs of functions from the
//! format (`cl-format` in valgrind's manual) and ignores calls.

use std::collections::HashMap;

use anyhow::{Context as _, Result, bail};
use serde::{Deserialize, Serialize};

/// The kind of code of an instruction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Kind {
    /// Rust: ours, and the crates that are compiled into it.
    Rust,
    /// C and assembler in the program: AWS-LC, which chooses it by the processor.
    Cryptography,
    /// The C library, which chooses `memcpy` by the processor and `malloc` by its version.
    Libc,
}

/// Instructions by kind of code.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Parts {
    /// Instructions of Rust code.
    pub(crate) rust: u64,
    /// Instructions of AWS-LC.
    pub(crate) cryptography: u64,
    /// Instructions of the C library.
    pub(crate) libc: u64,
}

impl Parts {
    /// Returns the sum of all kinds.
    pub(crate) fn sum(self) -> u64 {
        self.rust + self.cryptography + self.libc
    }
}

/// The counts of a run.
#[derive(Debug, Default)]
pub(crate) struct Profile {
    counts: HashMap<Kind, u64>,
}

impl Profile {
    /// Parses a file of callgrind. Fails if it is none, or counts anything but instructions.
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
                // The line after a call is the cost of the callee, which is counted at the callee itself.
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

    /// Returns the number of all instructions.
    pub(crate) fn sum(&self) -> u64 {
        self.counts.values().sum()
    }

    /// Returns the instructions by kind, for one of `times` repetitions.
    pub(crate) fn parts(&self, times: u64) -> Parts {
        let of = |kind| self.counts.get(&kind).copied().unwrap_or(0).div_ceil(times.max(1));
        Parts { rust: of(Kind::Rust), cryptography: of(Kind::Cryptography), libc: of(Kind::Libc) }
    }
}

/// Resolves a name: `(7) name` defines 7, and `(7)` refers to it.
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
    // Unresolved symbols of the C library appear under the loader's or the program's name.
    if function.starts_with("mem") || matches!(function, "malloc" | "free" | "calloc" | "realloc") {
        return Kind::Libc;
    }
    // Only Rust paths have colons here. Symbols of the compiler (`_R…`, `core::…`) are Rust as well.
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
    fn each_cost_is_counted_once_at_its_function() {
        let profile = Profile::parse(TEXT).unwrap();
        assert_eq!(profile.sum(), 590);
        assert_eq!(profile.parts(10), Parts { rust: 13, cryptography: 40, libc: 6 });
    }

    #[test]
    fn invalid_profile_is_an_error() {
        assert!(Profile::parse("").is_err());
        assert!(Profile::parse("events: Ir Dr\n").is_err());
        assert!(Profile::parse("events: Ir\nfn=(4)\n").is_err());
    }
}
