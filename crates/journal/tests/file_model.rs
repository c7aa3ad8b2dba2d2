//! Random layouts, steps, stops and reopenings, compared with memories that are not kept.

mod support;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use holdfast_journal::file::{MemoryFile, Options};
use holdfast_memory::{
    Access, Area, Gate, GateMode, Layout, Memory, Read, Refusal, Refused, Span, Write, write_across,
};
use proptest::prelude::*;
use support::sim::SimDisk;
use support::{contents, keep};

/// One memory of a file: which areas it has, and its gate.
#[derive(Debug, Clone)]
struct Shape {
    spans: [(u16, u32); 4],
    /// How many records the files of [`FILES`] have.
    files: [u32; 3],
    gate: Option<(u16, GateMode)>,
}

#[derive(Debug, Clone)]
enum Event {
    Write { memory: usize, client: bool, area: Area, address: u16, values: Vec<u16> },
    Mask { memory: usize, client: bool, area: Area, address: u16, masks: (u16, u16) },
    WriteThenRead { memory: usize, area: Area, address: u16, values: Vec<u16>, read: (u16, usize) },
    Across { client: bool, parts: Vec<(usize, Area, u16, Vec<u16>)> },
    Reopen { shapes: [Shape; 2], cleanly: bool },
}

/// Numbers of files.
const FILES: [u16; 3] = [1, 4, u16::MAX];

impl Shape {
    fn memory(&self) -> Arc<Memory> {
        let layout = Area::ALL
            .into_iter()
            .zip(self.spans)
            .fold(Layout::default(), |layout, (area, (start, size))| {
                layout.with(area, Span::new(start, size).unwrap())
            });
        let layout = FILES.into_iter().zip(self.files).fold(layout, |layout, (number, records)| {
            layout.with(Area::File(number), Span::new(0, records).unwrap())
        });
        let (start, size) = self.spans[0];
        let gate = self.gate.filter(|_| size > 0).map(|(address, mode)| Gate {
            area: Area::Coils,
            address: start + address % size as u16,
            mode,
        });
        Arc::new(Memory::new(layout, gate).unwrap())
    }
}

fn packed(area: Area, values: &[u16]) -> Vec<u8> {
    if !area.is_bits() {
        return values.iter().flat_map(|value| value.to_be_bytes()).collect();
    }
    let mut bytes = vec![0; values.len().div_ceil(8)];
    for (index, value) in values.iter().enumerate() {
        bytes[index / 8] |= ((value & 1) as u8) << (index % 8);
    }
    bytes
}

fn write<'b>(area: Area, address: u16, count: usize, bytes: &'b [u8]) -> Write<'b> {
    Write { area, address, count, bytes }
}

const fn access(client: bool) -> Access {
    if client { Access::Client } else { Access::Ingest }
}

/// Carries out an event, and returns what whoever asked for it sees.
fn carry_out(memories: &[Arc<Memory>; 2], event: &Event) -> Result<Vec<u8>, Refusal> {
    match event {
        Event::Write { memory, client, area, address, values } => {
            let bytes = packed(*area, values);
            let write = write(*area, *address, values.len(), &bytes);
            memories[*memory].write(access(*client), write).map(|()| Vec::new())
        }
        &Event::Mask { memory, client, area, address, masks: (and_mask, or_mask) } => memories
            [memory]
            .mask_write(access(client), area, address, and_mask, or_mask)
            .map(|()| Vec::new()),
        Event::WriteThenRead { memory, area, address, values, read: (from, count) } => {
            let bytes = packed(*area, values);
            let write = write(*area, *address, values.len(), &bytes);
            let mut out = vec![0; area.byte_len(*count)];
            let read = Read { area: *area, address: *from, count: *count, out: &mut out };
            memories[*memory].write_then_read(Access::Ingest, write, read).map(|()| out)
        }
        Event::Across { client, parts } => {
            let bytes: Vec<_> =
                parts.iter().map(|(_, area, _, values)| packed(*area, values)).collect();
            let writes: Vec<_> = parts
                .iter()
                .zip(&bytes)
                .map(|((memory, area, address, values), bytes)| {
                    (&*memories[*memory], write(*area, *address, values.len(), bytes))
                })
                .collect();
            let refusal = |Refused { refusal, .. }| refusal;
            write_across(access(*client), &writes).map(|_| Vec::new()).map_err(refusal)
        }
        Event::Reopen { .. } => unreachable!(),
    }
}

fn items(memory: &Memory) -> HashMap<(Area, u16), u16> {
    let addresses = |area| {
        let span = memory.span(area);
        (u32::from(span.start())..span.end()).map(move |address| (area, address as u16))
    };
    let value = |(area, address): (Area, u16)| {
        let mut out = [0; 2];
        let out = &mut out[..area.byte_len(1)];
        memory.read(Access::Ingest, Read { area, address, count: 1, out: &mut *out }).unwrap();
        ((area, address), out.iter().fold(0, |value, byte| value << 8 | u16::from(*byte)))
    };
    memory.layout().areas().flat_map(addresses).map(value).collect()
}

/// The items of a memory, also those that it had before.
type Past = HashMap<(Area, u16), u16>;

/// What a restart makes of a memory.
fn reopened(old: &Memory, past: &mut Past, shape: &Shape) -> Arc<Memory> {
    past.extend(items(old));
    let new = shape.memory();
    let closed = new.gate().filter(|gate| gate.mode == GateMode::Once);
    let mut writes = Vec::new();
    for (area, address) in items(&new).into_keys() {
        let is_gate = closed.is_some_and(|gate| (gate.area, gate.address) == (area, address));
        if let Some(value) = past.get(&(area, address)).filter(|_| !is_gate) {
            writes.push((area, address, packed(area, &[*value])));
        }
    }
    let writes: Vec<_> =
        writes.iter().map(|(area, address, bytes)| write(*area, *address, 1, bytes)).collect();
    if !writes.is_empty() {
        new.write_many(Access::Ingest, &writes).unwrap();
    }
    new
}

fn open(disk: &Arc<SimDisk>, memories: &[Arc<Memory>; 2], sync: Duration) -> MemoryFile {
    let named = [("one", &memories[0]), ("two", &memories[1])];
    keep(disk, &named, Options::new(sync)).unwrap()
}

fn shape() -> impl Strategy<Value = Shape> {
    let span = prop_oneof![
        3 => (0..300_u16, 0..700_u32),
        1 => Just((65_000, 536)),
        1 => Just((0, 0)),
    ];
    let mode = prop_oneof![Just(GateMode::Once), Just(GateMode::Level)];
    let gate = prop::option::weighted(0.3, (0..700_u16, mode));
    let records = prop_oneof![Just(0), Just(1), 0..700_u32];
    let shape = (prop::array::uniform4(span), prop::array::uniform3(records), gate);
    shape.prop_map(|(spans, files, gate)| Shape { spans, files, gate })
}

fn area() -> impl Strategy<Value = Area> {
    prop::sample::select([&Area::ALL[..], &FILES.map(Area::File)].concat())
}

fn address() -> impl Strategy<Value = u16> {
    prop_oneof![4 => 0..1000_u16, 1 => 64_990..=u16::MAX]
}

fn values() -> impl Strategy<Value = Vec<u16>> {
    prop_oneof![
        3 => prop::collection::vec(any::<u16>(), 0..5),
        1 => prop::collection::vec(any::<u16>(), 100..400),
    ]
}

fn event() -> impl Strategy<Value = Event> {
    let part = (0..2_usize, area(), address(), values());
    let read = (address(), 0..20_usize);
    let client = prop::bool::weighted(0.3);
    prop_oneof![
        6 => (0..2_usize, client, area(), address(), values()).prop_map(
            |(memory, client, area, address, values)|
                Event::Write { memory, client, area, address, values }
        ),
        2 => (0..2_usize, client, area(), address(), any::<(u16, u16)>()).prop_map(
            |(memory, client, area, address, masks)|
                Event::Mask { memory, client, area, address, masks }
        ),
        2 => (0..2_usize, area(), address(), values(), read).prop_map(
            |(memory, area, address, values, read)|
                Event::WriteThenRead { memory, area, address, values, read }
        ),
        2 => (client, prop::collection::vec(part, 1..4)).prop_map(
            |(client, parts)| Event::Across { client, parts }
        ),
        3 => (shape(), shape(), any::<bool>()).prop_map(
            |(one, two, cleanly)| Event::Reopen { shapes: [one, two], cleanly }
        ),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: support::cases(60, 3000),
        ..ProptestConfig::default()
    })]

    #[test]
    fn a_kept_memory_is_as_one_that_never_stops(
        shapes in prop::array::uniform2(shape()),
        at_once in any::<bool>(),
        events in prop::collection::vec(event(), 0..25),
    ) {
        let sync = Duration::from_secs(if at_once { 0 } else { 3600 });
        let mut disk = Arc::new(SimDisk::default());
        let mut model = [shapes[0].memory(), shapes[1].memory()];
        let mut kept = [shapes[0].memory(), shapes[1].memory()];
        let mut pasts = [Past::new(), Past::new()];
        let mut file = open(&disk, &kept, sync);
        for event in &events {
            if let Event::Reopen { shapes, cleanly } = event {
                // Without a stop, everything is there only if it was stored at once.
                if *cleanly || !at_once {
                    file.stop().unwrap();
                }
                disk = Arc::new(disk.power_back());
                drop(file);
                model = [0, 1].map(|at| reopened(&model[at], &mut pasts[at], &shapes[at]));
                kept = [shapes[0].memory(), shapes[1].memory()];
                file = open(&disk, &kept, sync);
            } else {
                prop_assert_eq!(carry_out(&kept, event), carry_out(&model, event));
            }
            for (kept, model) in kept.iter().zip(&model) {
                prop_assert_eq!(contents(kept), contents(model));
            }
        }
        file.stop().unwrap();
        for (kept, model) in kept.iter().zip(&model) {
            prop_assert_eq!(contents(kept), contents(model));
        }
    }
}
