//! A process that is killed at random moments, with a real file.

mod support;

use std::io::{BufRead, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use holdfast_journal::file::FileOnDisk;
use holdfast_memory::{Access, Memory, Write, write_across};
use support::{REGISTERS, Random, at_once, get, keep, layout, memory, rounds};

const WRITERS: u16 = 4;
const FILE: &str = "HOLDFAST_KILLED_FILE";

type Memories = [Arc<Memory>; 2];

fn memories() -> Memories {
    [memory(layout(0, 4096), None), memory(layout(0, 2000), None)]
}

/// The counter of a writer, which is in two memories and, in the first, at both ends.
fn counter(memories: &Memories, writer: u16) -> u32 {
    let [one, two] = memories;
    let number = |memory: &Memory, at: u16| {
        u32::from(get(memory, at)) << 16 | u32::from(get(memory, at + 1))
    };
    let places =
        [number(one, writer * 2), number(one, 4000 + writer * 2), number(two, writer * 300)];
    assert_eq!(places, [places[0]; 3], "a step of writer {writer} is partial");
    places[0]
}

fn count(memories: &Memories, writer: u16, value: u32) {
    let bytes = value.to_be_bytes();
    let at = |address| Write { area: REGISTERS, address, count: 2, bytes: &bytes };
    let [one, two] = memories;
    let step =
        [(&**one, at(writer * 2)), (&**one, at(4000 + writer * 2)), (&**two, at(writer * 300))];
    write_across(Access::Client, &step).unwrap();
}

/// Not a test: what the killed process does. Prints each write that was acknowledged.
#[test]
fn killed_process() {
    let Some(path) = std::env::var_os(FILE) else { return };
    let memories = memories();
    let disk = Arc::new(FileOnDisk::new(Path::new(&path)));
    let named = [("one", &memories[0]), ("two", &memories[1])];
    let _file = keep(&disk, &named, at_once()).unwrap();
    std::thread::scope(|threads| {
        for writer in 0..WRITERS {
            let memories = &memories;
            threads.spawn(move || {
                for value in counter(memories, writer) + 1.. {
                    count(memories, writer, value);
                    let line = format!("counted {writer} {value}\n");
                    if std::io::stdout().write_all(line.as_bytes()).is_err() {
                        return;
                    }
                }
            });
        }
    });
}

fn spawn(path: &Path) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "killed_process", "--nocapture", "--test-threads=1"])
        .env(FILE, path)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Reads what was acknowledged. `false` for a line that the kill has cut.
fn note(line: &[u8], acknowledged: &mut [u32; WRITERS as usize]) -> bool {
    let Some(line) = line.strip_suffix(b"\n") else { return false };
    let line = String::from_utf8_lossy(line);
    // The first line may begin with what the test runner prints.
    let Some((_, counted)) = line.split_once("counted ") else { return true };
    let (writer, value) = counted.split_once(' ').unwrap();
    acknowledged[writer.parse::<usize>().unwrap()] = value.parse().unwrap();
    true
}

fn folder() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("killed");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

#[test]
fn every_acknowledged_write_survives_a_kill_and_none_is_partial() {
    let path = folder().join("memories.redb");
    let mut random = Random(0);
    let mut acknowledged = [0; WRITERS as usize];
    for round in 0..rounds(20, 1000) {
        let mut child = spawn(&path);
        let mut lines = BufReader::new(child.stdout.take().unwrap());
        // Sometimes while it begins, which is before or after the file is open.
        for _ in 0..random.below(60) {
            let mut line = Vec::new();
            lines.read_until(b'\n', &mut line).unwrap();
            note(&line, &mut acknowledged);
        }
        for _ in 0..random.below(200_000) {
            std::hint::spin_loop();
        }
        child.kill().unwrap();
        child.wait().unwrap();
        let mut line = Vec::new();
        while lines.read_until(b'\n', &mut line).unwrap() > 0 {
            note(&line, &mut acknowledged);
            line.clear();
        }
        let memories = memories();
        let disk = Arc::new(FileOnDisk::new(&path));
        let named = [("one", &memories[0]), ("two", &memories[1])];
        let file = keep(&disk, &named, at_once()).unwrap();
        for writer in 0..WRITERS {
            let (found, known) = (counter(&memories, writer), acknowledged[usize::from(writer)]);
            let range = known..=known + 1;
            assert!(range.contains(&found), "round {round}, writer {writer}: {found} of {known}");
            acknowledged[usize::from(writer)] = found;
        }
        file.stop().unwrap();
    }
    assert!(acknowledged.iter().all(|counter| *counter > 20), "{acknowledged:?}");
}
