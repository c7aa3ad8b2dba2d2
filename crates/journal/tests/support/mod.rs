//! What the tests of this crate share.

#![allow(dead_code)]

pub mod sim;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use holdfast_journal::file::{Disk, FileError, Member, MemoryFile, Options};
use holdfast_memory::{
    Access, Area, Contents, Gate, Layout, Memory, Operation, Outcome, Refusal, Refused, Span, Write,
};

pub const REGISTERS: Area = Area::HoldingRegisters;

/// Random numbers that a seed repeats (SplitMix64).
#[derive(Debug, Clone)]
pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % end
    }

    pub fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// How many times a test repeats, in short and in `make torture`.
pub fn rounds(usual: u64, torture: u64) -> u64 {
    if std::env::var_os("HOLDFAST_TORTURE").is_some() { torture } else { usual }
}

/// How many cases a property test draws: in short, in `make torture`, and in `make explore`.
pub fn cases(usual: u32, torture: u32) -> u32 {
    let explored = std::env::var("PROPTEST_CASES").ok().map(|text| text.parse().unwrap());
    explored.unwrap_or(rounds(usual.into(), torture.into()) as u32)
}

pub fn layout(coils: u32, registers: u32) -> Layout {
    let span = |size| Span::new(0, size).unwrap();
    Layout::default().with(Area::Coils, span(coils)).with(REGISTERS, span(registers))
}

pub fn memory(layout: Layout, gate: Option<Gate>) -> Arc<Memory> {
    Arc::new(Memory::new(layout, gate).unwrap())
}

pub fn member(name: &str, memory: &Arc<Memory>) -> Member {
    Member { name: name.to_owned(), memory: Arc::clone(memory) }
}

pub fn at_once() -> Options {
    Options::new(Duration::ZERO)
}

/// Opens a file with memories, and starts.
pub fn keep(
    disk: &Arc<impl Disk + 'static>,
    memories: &[(&str, &Arc<Memory>)],
    options: Options,
) -> Result<MemoryFile, FileError> {
    let members = memories.iter().map(|(name, memory)| member(name, memory)).collect();
    let file = MemoryFile::open(Arc::clone(disk) as _, members, options)?;
    file.start(None)?;
    Ok(file)
}

pub fn contents(memory: &Arc<Memory>) -> Contents {
    Memory::contents(std::slice::from_ref(memory)).remove(0)
}

pub fn set(memory: &Memory, address: u16, value: u16) -> Result<(), Refusal> {
    let bytes = value.to_be_bytes();
    memory.write(Access::Ingest, Write { area: REGISTERS, address, count: 1, bytes: &bytes })
}

pub fn get(memory: &Memory, address: u16) -> u16 {
    let mut out = [0; 2];
    let read = holdfast_memory::Read { area: REGISTERS, address, count: 1, out: &mut out };
    memory.read(Access::Ingest, read).unwrap();
    u16::from_be_bytes(out)
}

/// Gives a write of one register to the journal.
pub fn submit(memory: &Memory, address: u16, value: u16) -> Receiver<Outcome> {
    let (sender, receiver) = channel();
    let bytes = value.to_be_bytes();
    let write = Write { area: REGISTERS, address, count: 1, bytes: &bytes };
    let answer = sender.clone();
    let done = Box::new(move |outcome| drop(answer.send(outcome)));
    if let Err(refusal) = memory.submit(Access::Ingest, Operation::Write(&[write]), done) {
        sender.send(Err(Refused { index: 0, refusal })).unwrap();
    }
    receiver
}

/// Waits until something is true.
pub fn until(what: &str, mut is_true: impl FnMut() -> bool) {
    for _ in 0..60_000 {
        if is_true() {
            return;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    panic!("{what} did not happen");
}
