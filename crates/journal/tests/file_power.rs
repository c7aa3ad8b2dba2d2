//! The power fails at random moments, on a disk that loses, reorders and tears what is not synced.

mod support;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

use holdfast_journal::file::{MemoryFile, Options, read_from};
use holdfast_memory::{
    Access, Area, CarriedOut, Contents, Gate, GateMode, Memory, Operation, Outcome, Span, Write,
    write_across,
};
use support::sim::SimDisk;
use support::{REGISTERS, Random, at_once, contents, keep, layout, memory, rounds, set, until};

const COUNT: u64 = 400;
const FILE: Area = Area::File(9);

type Memories = [Arc<Memory>; 2];

fn memories() -> Memories {
    let gate = Gate { area: Area::Coils, address: 70, mode: GateMode::Level };
    let with_file = layout(200, COUNT as u32).with(FILE, Span::new(0, COUNT as u32).unwrap());
    let before = Span::new(0, 100).unwrap();
    let with_files = with_file.with(Area::File(2), before);
    [memory(with_files, None), memory(layout(100, 50), Some(gate))]
}

fn open(disk: &Arc<SimDisk>, memories: &Memories) -> Option<MemoryFile> {
    keep(disk, &[("one", &memories[0]), ("two", &memories[1])], at_once()).ok()
}

/// A random step, as bytes to write.
#[derive(Clone)]
struct AnyStep {
    first: (u16, Vec<u8>),
    kind: u64,
}

fn random_step(random: &mut Random) -> AnyStep {
    let address = random.below(COUNT - 130) as u16;
    let most = if random.one_in(4) { 123 } else { 3 };
    let count = 1 + random.below(most);
    let bytes = (0..count * 2).map(|_| random.below(256) as u8).collect();
    AnyStep { first: (address, bytes), kind: random.below(5) }
}

fn write_of(step: &AnyStep) -> Write<'_> {
    let (address, bytes) = (step.first.0, &step.first.1);
    let area = if step.kind == 4 { FILE } else { REGISTERS };
    Write { area, address, count: bytes.len() / 2, bytes }
}

fn operation<'a>(step: &'a AnyStep, write: &'a Write<'a>) -> Operation<'a> {
    let (address, bytes, write) = (step.first.0, &step.first.1, std::slice::from_ref(write));
    match step.kind {
        0 => {
            let and_mask = u16::from_be_bytes([bytes[0], bytes[1]]);
            Operation::Mask { area: REGISTERS, address, and_mask, or_mask: 0x5aa5 }
        }
        1 => Operation::WriteThenRead { write: write[0], area: REGISTERS, address: 0, count: 4 },
        _ => Operation::Write(write),
    }
}

/// Carries out a step on memories without a journal.
fn on_model(model: &Memories, step: &AnyStep) {
    let write = write_of(step);
    match operation(step, &write) {
        Operation::Write(_) if step.kind == 3 => {
            let bits = Write { area: Area::Coils, address: 65, count: 8, bytes: &write.bytes[..1] };
            write_across(Access::Ingest, &[(&model[0], write), (&model[1], bits)]).unwrap();
        }
        Operation::Write(writes) => model[0].write_many(Access::Ingest, writes).unwrap(),
        Operation::Mask { area, address, and_mask, or_mask } => {
            model[0].mask_write(Access::Ingest, area, address, and_mask, or_mask).unwrap();
        }
        Operation::WriteThenRead { write, .. } => model[0].write(Access::Ingest, write).unwrap(),
    }
}

/// Gives a step away. Steps across memories wait on a thread of their own: they go alone.
fn submit(memories: &Memories, step: &AnyStep) -> Receiver<Outcome> {
    let (sender, receiver) = channel();
    if step.kind == 3 {
        let (memories, step) = (memories.clone(), step.clone());
        std::thread::spawn(move || {
            let write = write_of(&step);
            let bits = Write { area: Area::Coils, address: 65, count: 8, bytes: &write.bytes[..1] };
            let both = [(&*memories[0], write), (&*memories[1], bits)];
            let _ = sender.send(write_across(Access::Ingest, &both).map(|_| CarriedOut::default()));
        });
        return receiver;
    }
    let done = Box::new(move |outcome| drop(sender.send(outcome)));
    memories[0].submit(Access::Ingest, operation(step, &write_of(step)), done).unwrap();
    receiver
}

/// Gives steps away such that the first is alone, and the others are one group.
fn burst(disk: &SimDisk, memories: &Memories, steps: &[AnyStep]) -> usize {
    let answered = |outcome: &Receiver<Outcome>| outcome.recv().unwrap().is_ok();
    disk.hold(true);
    let first = submit(memories, &steps[0]);
    let mut outcome = None;
    until("the first step", || {
        outcome = outcome.take().or_else(|| first.try_recv().ok());
        outcome.is_some() || disk.is_blocking() || disk.is_off()
    });
    let rest: Vec<_> = steps[1..].iter().map(|step| submit(memories, step)).collect();
    disk.hold(false);
    let mut acknowledged = usize::from(outcome.map_or_else(|| answered(&first), |o| o.is_ok()));
    for outcome in &rest {
        let is_ok = answered(outcome);
        assert!(!is_ok || acknowledged > 0, "answered in order");
        acknowledged += usize::from(is_ok);
    }
    acknowledged
}

fn all(memories: &Memories) -> Vec<Contents> {
    Memory::contents(memories)
}

/// Runs until the power fails, then again, several times.
fn run(seed: u64) {
    let mut random = Random(seed);
    let mut disk = Arc::new(SimDisk::default());
    // What the file may contain, the oldest first: all after what was acknowledged.
    let mut possible = vec![all(&memories())];
    for boot in 0..4 {
        disk.cut_after(random.below(if boot == 0 { 150 } else { 60 }), random.below(u64::MAX));
        let now = memories();
        let file = open(&disk, &now);
        if file.is_some() {
            let found = all(&now);
            assert!(possible.contains(&found), "seed {seed}, boot {boot}: other contents");
            let model = memories();
            for (memory, contents) in model.iter().zip(&found) {
                memory.restore(contents);
            }
            possible = vec![found];
            for burst_number in 0.. {
                if disk.is_off() {
                    break;
                }
                assert!(burst_number < 1000, "seed {seed}: the disk is not used");
                let len = if random.one_in(2) { 1 } else { 2 + random.below(6) } as usize;
                let mut steps: Vec<_> = (0..len).map(|_| random_step(&mut random)).collect();
                // Steps across memories go alone: others could overtake them.
                if let Some(across) = steps.iter().position(|step| step.kind == 3) {
                    steps = vec![steps.swap_remove(across)];
                }
                let acknowledged = burst(&disk, &now, &steps);
                for (index, step) in steps.iter().enumerate() {
                    on_model(&model, step);
                    if index < acknowledged {
                        possible.clear();
                    }
                    possible.push(all(&model));
                }
                if acknowledged == steps.len() {
                    assert_eq!(all(&now), all(&model), "seed {seed}: acknowledged is visible");
                }
            }
        } else {
            assert!(disk.is_off(), "seed {seed}, boot {boot}: can't be opened");
        }
        drop(file);
        disk = Arc::new(disk.power_back());
    }
    let last = memories();
    let file = open(&disk, &last);
    assert!(file.is_some(), "seed {seed}: {:?}", read_from(&*disk).map(drop));
    assert!(possible.contains(&all(&last)), "seed {seed}: other contents at the end");
}

#[test]
fn every_acknowledged_step_survives_a_power_cut_and_none_is_partial() {
    for seed in 0..rounds(150, 5000) {
        run(seed);
    }
}

#[test]
fn syncs_that_fail_and_forget_lose_nothing_that_was_acknowledged() {
    for seed in 0..rounds(60, 5000) {
        let mut random = Random(seed);
        let disk = Arc::new(SimDisk::default());
        let now = memories();
        let options = Options { retry: std::time::Duration::from_secs(3600), ..at_once() };
        let file = keep(&disk, &[("one", &now[0]), ("two", &now[1])], options).unwrap();
        let model = memories();
        disk.cut_after(20 + random.below(300), random.below(u64::MAX));
        disk.fail_syncs(Some(3));
        let mut possible = vec![all(&model)];
        for number in 0.. {
            if disk.is_off() {
                break;
            }
            assert!(number < 1000, "seed {seed}: the disk is not used");
            let step = random_step(&mut random);
            let outcome = submit(&now, &step).recv().unwrap();
            // What was refused may be stored until the next step is.
            let refused = memories();
            for (memory, contents) in refused.iter().zip(all(&model)) {
                memory.restore(&contents);
            }
            on_model(&refused, &step);
            if outcome.is_ok() {
                possible.clear();
                on_model(&model, &step);
            }
            assert_eq!(all(&now), all(&model), "seed {seed}: refused changes nothing");
            possible.push(all(&refused));
            possible.push(all(&model));
        }
        drop(file);
        let disk = Arc::new(disk.power_back());
        let last = memories();
        let file = open(&disk, &last);
        assert!(file.is_some(), "seed {seed}: {:?}", read_from(&*disk).map(drop));
        assert!(possible.contains(&all(&last)), "seed {seed}: other contents");
    }
}

#[test]
fn a_power_cut_at_a_start_with_smaller_areas_loses_nothing() {
    for seed in 0..rounds(60, 2000) {
        let mut random = Random(seed);
        let disk = Arc::new(SimDisk::default());
        let whole = || memory(layout(200, COUNT as u32), None);
        let before = whole();
        let file = keep(&disk, &[("one", &before)], at_once()).unwrap();
        for address in 0..COUNT as u16 {
            set(&before, address, address + 1).unwrap();
        }
        file.stop().unwrap();
        disk.cut_after(random.below(60), random.below(u64::MAX));
        // Perhaps it fails; perhaps the power fails after it.
        drop(keep(&disk, &[("one", &memory(layout(0, 7), None))], at_once()));
        let disk = Arc::new(disk.power_back());
        let after = whole();
        keep(&disk, &[("one", &after)], at_once()).unwrap();
        assert_eq!(contents(&after), contents(&before), "seed {seed}");
    }
}
