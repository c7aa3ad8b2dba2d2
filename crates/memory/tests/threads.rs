//! Concurrent access: no reader ever sees part of a write.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use holdfast_memory::{Access, Area, Layout, Memory, Read, Span, Write, write_across};

const COUNT: usize = 99;
const ROUNDS: usize = 3_000;

fn memory() -> Memory {
    let span = Span::new(7, 200).unwrap();
    let layout =
        Area::ALL.into_iter().fold(Layout::default(), |layout, area| layout.with(area, span));
    Memory::new(layout, None).unwrap()
}

/// The content of one write: `round` in every register, its parity in every bit.
fn mark(round: usize) -> (Vec<u8>, Vec<u8>) {
    let word = (round as u16).to_be_bytes();
    let bits = if round.is_multiple_of(2) { 0x00 } else { 0xFF };
    (word.repeat(COUNT), vec![bits; COUNT.div_ceil(8)])
}

fn writes<'a>(registers: &'a [u8], bits: &'a [u8]) -> [Write<'a>; 4] {
    Area::ALL.map(|area| Write {
        area,
        address: 10,
        count: COUNT,
        bytes: if area.is_bits() { bits } else { registers },
    })
}

/// The value of all items of a range; `None` when the values differ.
fn uniform(area: Area, bytes: &[u8]) -> Option<u16> {
    if area.is_bits() {
        let (last, whole) = bytes.split_last()?;
        let full = whole.iter().all(|&byte| byte == whole[0]);
        let same = *last == whole[0] & 0b111;
        (full && same).then_some(u16::from(whole[0] & 1))
    } else {
        let all = bytes.chunks(2).all(|pair| pair == &bytes[..2]);
        all.then_some(u16::from_be_bytes([bytes[0], bytes[1]]))
    }
}

fn read_all(memory: &Memory) -> [Option<u16>; 4] {
    let mut outs = Area::ALL.map(|area| vec![0; area.byte_len(COUNT)]);
    let mut areas = Area::ALL.iter();
    let mut reads = outs.each_mut().map(|out| Read {
        area: *areas.next().unwrap(),
        address: 10,
        count: COUNT,
        out,
    });
    memory.read_many(Access::Client, &mut reads).unwrap();
    let mut outs = outs.iter();
    Area::ALL.map(|area| uniform(area, outs.next().unwrap()))
}

#[test]
fn no_reader_sees_part_of_a_write_over_four_areas() {
    let memory = memory();
    let writing = AtomicBool::new(true);
    thread::scope(|scope| {
        let readers: Vec<_> = (0..4)
            .map(|_| {
                scope.spawn(|| {
                    let mut seen = 0u32;
                    while writing.load(Ordering::Relaxed) {
                        let [coils, inputs, holding, input] = read_all(&memory);
                        let register = holding.expect("holding registers of one write");
                        assert_eq!(input, Some(register));
                        assert_eq!(coils, Some(register & 1));
                        assert_eq!(inputs, Some(register & 1));
                        seen += 1;
                    }
                    seen
                })
            })
            .collect();
        let writers: Vec<_> = (0..2)
            .map(|writer| {
                let memory = &memory;
                scope.spawn(move || {
                    for round in 0..ROUNDS {
                        let (registers, bits) = mark(round * 2 + writer);
                        memory.write_many(Access::Client, &writes(&registers, &bits)).unwrap();
                    }
                })
            })
            .collect();
        writers.into_iter().for_each(|writer| writer.join().unwrap());
        writing.store(false, Ordering::Relaxed);
        for reader in readers {
            reader.join().unwrap();
        }
    });
}

#[test]
fn concurrent_mask_writes_lose_no_bit() {
    let memory = memory();
    thread::scope(|scope| {
        for bit in 0..16u16 {
            let memory = &memory;
            scope.spawn(move || {
                for round in 0..501u16 {
                    let on = round.is_multiple_of(2);
                    let or_mask = u16::from(on) << bit;
                    memory
                        .mask_write(Access::Client, Area::HoldingRegisters, 7, !(1 << bit), or_mask)
                        .unwrap();
                }
            });
        }
    });
    let mut out = [0; 2];
    let read = Read { area: Area::HoldingRegisters, address: 7, count: 1, out: &mut out };
    memory.read(Access::Client, read).unwrap();
    assert_eq!(out, [0xFF, 0xFF]);
}

#[test]
fn writers_to_the_same_memories_in_any_order_never_deadlock() {
    let memories = [memory(), memory()];
    thread::scope(|scope| {
        for order in [[0, 1], [1, 0]] {
            let memories = &memories;
            scope.spawn(move || {
                for round in 0..ROUNDS {
                    let bytes = (round as u16).to_be_bytes();
                    let area = Area::HoldingRegisters;
                    let writes = order.map(|which| {
                        (&memories[which], Write { area, address: 7, count: 1, bytes: &bytes })
                    });
                    write_across(Access::Ingest, &writes).unwrap();
                }
            });
        }
    });
}

#[test]
fn a_write_then_read_returns_what_it_wrote() {
    let memory = memory();
    thread::scope(|scope| {
        for thread in 0..4u16 {
            let memory = &memory;
            scope.spawn(move || {
                for round in 0..1_000u16 {
                    let bytes = (thread * 1_000 + round).to_be_bytes().repeat(20);
                    let mut out = [0; 40];
                    let area = Area::HoldingRegisters;
                    memory
                        .write_then_read(
                            Access::Client,
                            Write { area, address: 50, count: 20, bytes: &bytes },
                            Read { area, address: 50, count: 20, out: &mut out },
                        )
                        .unwrap();
                    assert_eq!(out, bytes[..]);
                }
            });
        }
    });
}

#[test]
fn a_queue_of_writes_waits_for_the_next_one() {
    let memory = memory();
    let queue = memory.observe(false);
    let (ask, asked) = std::sync::mpsc::sync_channel(0);
    thread::scope(|scope| {
        scope.spawn(|| {
            for () in asked {
                let write = Write { area: Area::Coils, address: 7, count: 1, bytes: &[1] };
                memory.write(Access::Ingest, write).unwrap();
            }
        });
        for _ in 0..200 {
            ask.send(()).unwrap();
            assert!(queue.next(std::time::Duration::from_secs(20)).is_some());
        }
        drop(ask);
    });
}
