//! Gives the checks inputs of their corpora with random changes. Without a look at coverage, these are many
//! times as many as `make fuzz` gives in the same time.
//!
//! `random SEED SECONDS [TARGET]`: the seconds are those of each target. An input that fails is kept in
//! `artifacts`, as those of `make fuzz` are.

#![forbid(unsafe_code)]

use std::env;
use std::fs;
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};
use std::process::{self, ExitCode};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use holdfast_fuzz::{Check, TARGETS};

/// Inputs between two looks at the clock.
const BATCH: u64 = 256;

/// A check that takes longer than this has failed.
const TOO_LONG: Duration = Duration::from_secs(10);

const MAX_CHANGES: usize = 6;
const MAX_LEN: usize = 1024;

/// Bytes that stand at the ends of ranges.
const ENDS: [u8; 8] = [0, 1, 6, 0x7D, 0x7F, 0x80, 0xFD, 0xFF];

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let (seed, seconds, only) = match &arguments[..] {
        [seed, seconds] => (seed, seconds, None),
        [seed, seconds, target] => (seed, seconds, Some(target)),
        _ => panic!("usage: random SEED SECONDS [TARGET]"),
    };
    let seed: u64 = seed.parse().expect("a number as seed");
    let time = Duration::from_secs(seconds.parse().expect("a number of seconds"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut has_failed = false;
    for (name, check) in TARGETS {
        if only.is_none_or(|only| only == name) {
            has_failed |= !passes(root, name, check, seed, time);
        }
    }
    if has_failed { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

/// Runs one check for this time. Whether it held for all inputs.
fn passes(root: &Path, name: &'static str, check: Check, seed: u64, time: Duration) -> bool {
    let found = root.join("../.cache/fuzz").join(name);
    let corpus = [inputs(&root.join("corpus").join(name)), inputs(&found)].concat();
    assert!(!corpus.is_empty(), "each target has a corpus");
    let artifacts = root.join("artifacts").join(name);
    let current = Arc::new(Mutex::new(Vec::new()));
    let watched = Arc::clone(&current);
    let folder = artifacts.clone();
    let watchdog = thread::spawn(move || end_if_stuck(&watched, &folder, name));
    let mut random = Random(seed | 1);
    let start = Instant::now();
    let (mut count, mut holds) = (0_u64, true);
    while holds && start.elapsed() < time {
        for _ in 0..BATCH {
            let input = random.changed(&corpus);
            current.lock().expect("no check holds it").clone_from(&input);
            count += 1;
            if catch_unwind(|| check(&input)).is_err() {
                println!("{name}: FAILED for {}", kept(&artifacts, &input).display());
                holds = false;
                break;
            }
        }
    }
    drop(current);
    watchdog.join().expect("a look at an input does not fail");
    println!("{name}: {count} inputs in {} s, seed {seed}", start.elapsed().as_secs());
    holds
}

/// Ends the program if one input takes too long. It looks now and then: a check that never ends signals nothing.
fn end_if_stuck(current: &Arc<Mutex<Vec<u8>>>, folder: &Path, name: &str) {
    let (mut seen, mut since) = (Vec::new(), Instant::now());
    while Arc::strong_count(current) > 1 {
        thread::sleep(Duration::from_millis(200));
        let now = current.lock().expect("no check holds it").clone();
        if now != seen {
            (seen, since) = (now, Instant::now());
        } else if since.elapsed() > TOO_LONG {
            println!("{name}: FAILED, takes too long for {}", kept(folder, &seen).display());
            process::exit(1);
        }
    }
}

fn inputs(folder: &Path) -> Vec<Vec<u8>> {
    let Ok(files) = fs::read_dir(folder) else { return Vec::new() };
    let mut paths: Vec<PathBuf> = files.map(|file| file.expect("a file").path()).collect();
    paths.sort();
    paths.iter().map(|path| fs::read(path).expect("a file that can be read")).collect()
}

fn kept(folder: &Path, input: &[u8]) -> PathBuf {
    let time = SystemTime::now().duration_since(UNIX_EPOCH).expect("a time after 1970");
    let path = folder.join(format!("random-{}", time.as_nanos()));
    fs::create_dir_all(folder).expect("a folder for inputs that fail");
    fs::write(&path, input).expect("space for an input");
    path
}

/// Xorshift, whose numbers are the same on each machine.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 32).expect("half of its bits") % end
    }

    fn byte(&mut self) -> u8 {
        if self.below(2) == 0 { ENDS[self.below(ENDS.len())] } else { self.below(256) as u8 }
    }

    /// An input of a corpus with some changes.
    fn changed(&mut self, corpus: &[Vec<u8>]) -> Vec<u8> {
        let mut input = corpus[self.below(corpus.len())].clone();
        for _ in 0..=self.below(MAX_CHANGES) {
            let at = self.below(input.len() + 1);
            match self.below(6) {
                0 => input.insert(at, self.byte()),
                1 => input.truncate(at),
                2 if at < input.len() => {
                    input.remove(at);
                }
                3 => {
                    let other = &corpus[self.below(corpus.len())];
                    let from = self.below(other.len() + 1);
                    let len = self.below(other.len() - from + 1);
                    input.splice(at..at, other[from..from + len].iter().copied());
                }
                4 if at < input.len() => input[at] ^= 1 << self.below(8),
                _ if at < input.len() => input[at] = self.byte(),
                _ => {}
            }
        }
        input.truncate(MAX_LEN.max(corpus.iter().map(Vec::len).max().unwrap_or_default()));
        input
    }
}
