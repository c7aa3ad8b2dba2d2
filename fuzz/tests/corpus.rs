//! The checks of all targets, with the inputs of `corpus`, and with changed ones: the same in every run.

use std::fs;
use std::panic::catch_unwind;
use std::path::Path;

use holdfast_fuzz::{Check, TARGETS};

/// Changed inputs of each target, and of a target whose inputs take long.
const CHANGED: usize = 5_000;
const CHANGED_OF_SLOW: usize = 300;
const SLOW: [&str; 2] = ["file", "http"];

#[test]
fn all_inputs_of_the_corpus_pass() {
    for (name, check) in TARGETS {
        for (file, input) in corpus(name) {
            run(name, check, &input, &file);
        }
    }
}

#[test]
fn changed_inputs_pass() {
    for (name, check) in TARGETS {
        let (inputs, mut random) = (corpus(name), Random(0));
        let count = if SLOW.contains(&name) { CHANGED_OF_SLOW } else { CHANGED };
        for number in 0..count {
            let input = random.changed(&inputs);
            run(name, check, &input, &format!("changed input {number}"));
        }
    }
}

/// The inputs of a target, with the names of their files, in the order of these.
fn corpus(target: &str) -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target);
    let entries = fs::read_dir(&folder).unwrap_or_else(|error| panic!("{folder:?}: {error}"));
    let mut inputs: Vec<_> = entries
        .map(|entry| entry.unwrap())
        .map(|entry| (entry.file_name().into_string().unwrap(), fs::read(entry.path()).unwrap()))
        .collect();
    inputs.sort();
    assert!(!inputs.is_empty(), "{folder:?} is empty");
    inputs
}

fn run(target: &str, check: Check, input: &[u8], about: &str) {
    let result = catch_unwind(|| check(input));
    assert!(result.is_ok(), "target {target}, {about}: {input:02x?}");
}

/// The generator SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }

    /// The beginning of one input, the end of another or random bytes, and a few bytes changed.
    fn changed(&mut self, inputs: &[(String, Vec<u8>)]) -> Vec<u8> {
        let one = &inputs[self.below(inputs.len())].1;
        let mut changed = one[..self.below(one.len() + 1)].to_vec();
        if self.below(2) == 0 {
            let other = &inputs[self.below(inputs.len())].1;
            changed.extend_from_slice(&other[self.below(other.len() + 1)..]);
        } else {
            changed.extend((0..self.below(300)).map(|_| self.next() as u8));
        }
        for _ in 0..self.below(4) {
            let at = self.below(changed.len() + 1);
            if let Some(byte) = changed.get_mut(at) {
                *byte = self.next() as u8;
            }
        }
        changed
    }
}
