//! A node of a log as a process, for tests that kill and stop it.
//!
//! Arguments: the name of the node, the servers (with commas between), the number of replicas, then
//! options. Commands on standard input, one a line, each with a number that its answer repeats:
//! `1 write ADDRESS VALUE`, `2 read ADDRESS`, `3 dump`.

use std::env::args;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{BufRead, Write as _, stdin, stdout};
use std::sync::Arc;
use std::time::Duration;

use holdfast_journal::log::{Log, Settings, WhenBehind};
use holdfast_memory::{
    Access, Area, Layout, Memory, Operation, Outcome, Read, Refusal, Span, Write,
};

fn main() {
    let mut arguments = args().skip(1);
    let mut next = || arguments.next().expect("the name of the node, servers and replicas");
    let (name, servers, replicas) = (next(), next(), next());
    let servers = servers.split(',').map(str::to_owned).collect();
    let mut settings = Settings::new("torture", &name, servers);
    settings.replicas = replicas.parse().expect("replicas");
    for option in arguments {
        match option.as_str() {
            "answers-early" => settings.answers_early = true,
            "refuse" => {
                settings.when_behind = WhenBehind::Refuse;
                settings.max_lag = Duration::from_secs(1);
            }
            "snapshots" => {
                settings.snapshot_steps = 300;
                settings.digest_every = 500;
            }
            _ => panic!("unknown option {option}"),
        }
    }
    let layout = Layout::default().with(Area::HoldingRegisters, Span::new(0, 65_536).unwrap());
    let memory = Arc::new(Memory::new(layout, None).unwrap());
    let log = Log::new(settings, vec![("plant".to_owned(), Arc::clone(&memory))]).unwrap();
    log.start().unwrap();
    while !log.wait_until_caught_up(Duration::from_millis(100)).unwrap() {}
    answer("0", "ready");
    for line in stdin().lock().lines() {
        let line = line.unwrap();
        let words: Vec<&str> = line.split(' ').collect();
        let number = |at: usize| words[at].parse::<u16>().unwrap();
        match words[1] {
            "write" => write(&memory, words[0].to_owned(), number(2), number(3)),
            "read" => read(&memory, words[0], number(2)),
            "dump" => {
                let mut hasher = DefaultHasher::new();
                Memory::contents(std::slice::from_ref(&memory))[0].areas.hash(&mut hasher);
                answer(words[0], &format!("ok {}", hasher.finish()));
            }
            other => panic!("unknown command {other}"),
        }
        for event in log.take_events(Duration::ZERO) {
            eprintln!("{name} {event:?}");
        }
    }
    log.stop();
}

fn write(memory: &Memory, id: String, address: u16, value: u16) {
    let bytes = value.to_be_bytes();
    let write = Write { area: Area::HoldingRegisters, address, count: 1, bytes: &bytes };
    let answered = id.clone();
    let done = Box::new(move |outcome: Outcome| match outcome {
        Ok(_) => answer(&answered, "ok 0"),
        Err(refused) => refuse(&answered, refused.refusal),
    });
    if let Err(refusal) = memory.submit(Access::Client, Operation::Write(write), done) {
        refuse(&id, refusal);
    }
}

fn read(memory: &Memory, id: &str, address: u16) {
    let mut out = [0; 2];
    let read = Read { area: Area::HoldingRegisters, address, count: 1, out: &mut out };
    match memory.read(Access::Client, read) {
        Ok(()) => answer(id, &format!("ok {}", u16::from_be_bytes(out))),
        Err(refusal) => refuse(id, refusal),
    }
}

fn refuse(id: &str, refusal: Refusal) {
    answer(id, if refusal == Refusal::NotConfirmed { "unknown" } else { "refused" });
}

fn answer(id: &str, text: &str) {
    let mut out = stdout().lock();
    // Whoever asked may be gone.
    let _ = writeln!(out, "{id} {text}").and_then(|()| out.flush());
}
