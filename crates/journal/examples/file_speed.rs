//! How fast steps are stored before they are answered, beside a loop that writes and syncs 4 KiB.
//!
//! `cargo run --release -p holdfast-journal --example file_speed -- FOLDER [WRITES]`: medians of several
//! rounds, in which everything is measured by turns. Then WRITES writes of one register, and the size
//! of the file.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};

use holdfast_journal::file::{FileOnDisk, Member, MemoryFile, Options};
use holdfast_memory::{Access, Area, Layout, Memory, Operation, Span, Write};

const ROUNDS: usize = 7;
const TIME: Duration = Duration::from_millis(700);
const WRITERS: [usize; 3] = [1, 16, 64];
const REGISTERS: u16 = 10_000;

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Repeats something for a while. Returns the time of each.
fn repeat(mut once: impl FnMut(u16)) -> Vec<f64> {
    let (began, mut times) = (Instant::now(), Vec::new());
    while began.elapsed() < TIME {
        let before = Instant::now();
        once(times.len() as u16);
        times.push(before.elapsed().as_secs_f64());
    }
    times
}

fn set(memory: &Memory, address: u16, value: u16) {
    let bytes = value.to_be_bytes();
    let write = Write { area: Area::HoldingRegisters, address, count: 1, bytes: &bytes };
    memory.write(Access::Client, write).expect("the write is stored");
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().expect("FOLDER is the first argument");
    let writes: u32 = arguments.next().map_or(0, |text| text.parse().expect("WRITES is a number"));
    let path = Path::new(&folder).join("speed.redb");
    let bare_path = Path::new(&folder).join("speed.bare");
    let layout = Layout::default().with(
        Area::HoldingRegisters,
        Span::new(0, u32::from(REGISTERS)).expect("the span is valid"),
    );
    let memory = Arc::new(Memory::new(layout, None).expect("the layout is valid"));
    let members = vec![Member { name: "memory".to_owned(), memory: Arc::clone(&memory) }];
    let disk = Arc::new(FileOnDisk::new(&path));
    let options = Options::new(Duration::ZERO);
    let file = MemoryFile::open(disk, members, options).expect("the file can be opened");
    file.start(None).expect("the file can be written");

    let mut bare = File::create(&bare_path).expect("the folder can be written");
    bare.write_all(&[0; 1 << 20]).and_then(|()| bare.sync_all()).expect("there is room");
    let (mut loops, mut latency) = (Vec::new(), Vec::new());
    let mut kept = WRITERS.map(|_| (Vec::new(), Vec::new(), Vec::new()));
    for _ in 0..ROUNDS {
        let times = repeat(|number| {
            bare.seek(SeekFrom::Start(u64::from(number % 256) * 4096)).expect("it can be sought");
            bare.write_all(&number.to_be_bytes().repeat(2048)).expect("there is room");
            bare.sync_data().expect("it can be synced");
        });
        loops.push(times.len() as f64 / times.iter().sum::<f64>());
        latency.push(median(times));
        for (writers, (rates, latencies, groups)) in WRITERS.iter().zip(&mut kept) {
            let (began, commits) = (Instant::now(), file.status().commits);
            let times: Vec<f64> = std::thread::scope(|threads| {
                let threads: Vec<_> = (0..*writers)
                    .map(|writer| {
                        let memory = &memory;
                        threads.spawn(move || {
                            let spread = writer as u16 * (REGISTERS / 64);
                            let value = (began.elapsed().as_nanos() & 0x7fff) as u16;
                            repeat(|number| {
                                set(memory, spread + number % 100, value ^ number ^ (number / 100));
                            })
                        })
                    })
                    .collect();
                threads.into_iter().flat_map(|thread| thread.join().expect("no panic")).collect()
            });
            let count = times.len() as f64;
            rates.push(count / began.elapsed().as_secs_f64());
            groups.push(count / (file.status().commits - commits) as f64);
            latencies.push(median(times));
        }
    }
    let (rate, bare_latency) = (median(loops), median(latency));
    println!("bare write and sync: {rate:.0}/s, p50 {:.0} us", bare_latency * 1e6);
    for (writers, (rates, latencies, groups)) in WRITERS.iter().zip(kept) {
        let (steps, p50, group) = (median(rates), median(latencies), median(groups));
        println!(
            "{writers:2} writers: {steps:.0} steps/s ({:.2} of bare), p50 {:.0} us ({:.2} of bare), \
             {group:.1} steps a transaction",
            steps / rate,
            p50 * 1e6,
            p50 / bare_latency,
        );
    }
    for number in 0..writes {
        let (sender, receiver) = sync_channel::<()>(1);
        let bytes = (number as u16 ^ (number >> 16) as u16).to_be_bytes();
        let address = (number.wrapping_mul(2_654_435_761) >> 16) as u16 % REGISTERS;
        let area = Area::HoldingRegisters;
        let write = Write { area, address, count: 1, bytes: &bytes };
        let operation = Operation::Write(std::slice::from_ref(&write));
        let done = Box::new(move |outcome: holdfast_memory::Outcome| {
            outcome.expect("the write is stored");
            drop(sender);
        });
        memory.submit(Access::Client, operation, done).expect("the write is valid");
        // Eight writes wait at once.
        if number % 8 == 7 {
            let _ = receiver.recv();
        }
        if (number + 1) % 100_000 == 0 {
            let status = file.status();
            println!(
                "{} writes, {} transactions: {} bytes",
                number + 1,
                status.commits,
                status.bytes
            );
        }
    }
    file.stop().expect("everything is stored");
    println!("after the stop: {} bytes", std::fs::metadata(&path).map_or(0, |file| file.len()));
    let _ = (std::fs::remove_file(&path), std::fs::remove_file(&bare_path));
}
