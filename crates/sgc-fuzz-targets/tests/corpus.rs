//! Runs every fuzz target over its committed inputs, and over alterations of them from a fixed seed.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::{env, fs};

use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore, SeedableRng};
use sgc_fuzz_targets::TARGETS;
use sgc_wire::{Decode, DecodeError, GrantContent};

/// Number of altered inputs for each target, unless `SGC_FUZZ_RUNS` sets another.
const RUNS: usize = 300;
/// Longest altered input in bytes.
const INPUT_BYTES_MAX: usize = 8192;

/// Returns the committed inputs of a target in the order of their names.
fn corpus(target: &str) -> Vec<(String, Vec<u8>)> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus").join(target);
    let entries = fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut inputs: Vec<_> = entries
        .map(|entry| {
            let path = entry.expect("an entry").path();
            (path.display().to_string(), fs::read(&path).expect("a readable input"))
        })
        .collect();
    inputs.sort();
    assert!(!inputs.is_empty(), "{} holds no input", folder.display());
    inputs
}

/// Returns an input made of one or two others: bytes changed, removed, doubled or joined.
fn altered(inputs: &[(String, Vec<u8>)], rng: &mut ChaCha20Rng) -> Vec<u8> {
    let pick = |rng: &mut ChaCha20Rng, below: usize| (rng.next_u64() % below.max(1) as u64) as usize;
    let mut input = inputs[pick(rng, inputs.len())].1.clone();
    for _ in 0..=pick(rng, 4) {
        let (from, to) = (pick(rng, input.len() + 1), pick(rng, input.len() + 1));
        let (from, to) = (from.min(to), from.max(to));
        match pick(rng, 6) {
            0 => input.truncate(to),
            1 => drop(input.drain(from..to)),
            2 => input.extend_from_within(from..to),
            3 => {
                let other = &inputs[pick(rng, inputs.len())].1;
                let start = pick(rng, other.len() + 1);
                input.truncate(to);
                input.extend_from_slice(&other[start..]);
            }
            4 => input.insert(from, [0, 1, 0x7f, 0x80, 0xff][pick(rng, 5)]),
            _ => {
                if let Some(byte) = input.get_mut(from) {
                    *byte ^= 1 << pick(rng, 8);
                }
            }
        }
        input.truncate(INPUT_BYTES_MAX);
    }
    input
}

#[test]
fn corpus_has_a_sample_of_each_content_of_a_grant() {
    // `bodies` reads a grant behind a 3; the next byte is the tag of its content.
    let is_grant =
        |input: &Vec<u8>| input.first() == Some(&3) && GrantContent::from_slice(&input[1..]).is_ok();
    let inputs = corpus("bodies").into_iter().map(|(_, input)| input);
    let tags: BTreeSet<u8> = inputs.filter(is_grant).map(|input| input[1]).collect();
    let none_beyond = GrantContent::from_slice(&[tags.len() as u8]);
    assert!(tags.iter().copied().eq(0..tags.len() as u8), "{tags:?}");
    assert_eq!(none_beyond, Err(DecodeError::value("grant content", tags.len() as u64)));
}

#[test]
fn committed_inputs_show_no_defect() {
    for (name, target) in TARGETS {
        for (path, input) in corpus(name) {
            // libtest prints what a failing test wrote, so the last line names the input.
            println!("{path}");
            target(&input);
        }
    }
}

#[test]
fn altered_inputs_show_no_defect() {
    let runs =
        env::var("SGC_FUZZ_RUNS").map_or(RUNS, |runs| runs.parse().expect("a number in SGC_FUZZ_RUNS"));
    for (name, target) in TARGETS {
        let inputs = corpus(name);
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        for run in 0..runs {
            let input = altered(&inputs, &mut rng);
            println!("{name}, run {run}: {input:02x?}");
            target(&input);
        }
    }
}
