//! Where the bytes of items are, and what the seal and the queue of writes make of them.

use std::time::Duration;

use holdfast_memory::{Access, Area, Gate, GateMode, Layout, Memory, Refusal, Span, Write};

const REGISTERS: Area = Area::HoldingRegisters;

fn span(start: u16, size: u32) -> Span {
    Span::new(start, size).unwrap()
}

fn bit(bytes: &[u8], at: usize) -> bool {
    bytes[at / 8] & (1 << (at % 8)) != 0
}

#[test]
fn items_are_copied_from_any_place_to_any_other_and_those_around_them_stay() {
    let mut registers = [0xEE; 12];
    REGISTERS.copy(&[1, 2, 3, 4, 5, 6, 7, 8], 1, &mut registers, 3, 2);
    assert_eq!(registers, [0xEE, 0xEE, 0xEE, 0xEE, 0xEE, 0xEE, 3, 4, 5, 6, 0xEE, 0xEE]);
    let from = [0b1011_0010, 0b0110_1101, 0b1100_0101];
    for (at, to) in (0..14).flat_map(|at| (0..14).map(move |to| (at, to))) {
        for before in [0x00, 0xFF] {
            let mut coils = [before; 3];
            Area::Coils.copy(&from, at, &mut coils, to, 10);
            for place in 0..24 {
                let is_copied = (to..to + 10).contains(&place);
                let expected = if is_copied { bit(&from, at + place - to) } else { before == 0xFF };
                assert_eq!(bit(&coils, place), expected, "{at} {to} {place}");
            }
        }
    }
}

#[test]
fn a_range_of_items_has_its_bytes_behind_those_of_lower_addresses_and_files() {
    let layout = Layout::default()
        .with(Area::Coils, span(100, 50))
        .with(REGISTERS, span(10, 20))
        .with(Area::File(7), span(0, 5))
        .with(Area::File(3), span(2, 4));
    assert_eq!(layout.byte_lens(), [7, 0, 40, 0, 18]);
    for (area, address, count, expected) in [
        (Area::Coils, 103, 9, Some((0, 0..2))),
        (Area::Coils, 109, 7, Some((0, 1..2))),
        (Area::Coils, 109, 8, Some((0, 1..3))),
        (Area::Coils, 149, 2, None),
        (REGISTERS, 12, 3, Some((2, 4..10))),
        (REGISTERS, 29, 1, Some((2, 38..40))),
        (REGISTERS, 9, 1, None),
        (REGISTERS, 12, 0, None),
        (Area::InputRegisters, 0, 1, None),
        (Area::File(3), 2, 4, Some((4, 0..8))),
        (Area::File(7), 1, 2, Some((4, 10..14))),
        (Area::File(7), 4, 2, None),
        (Area::File(4), 0, 1, None),
    ] {
        assert_eq!(layout.bytes(area, address, count), expected, "{area:?} {address} {count}");
    }
}

#[test]
fn a_file_of_a_layout_can_be_replaced_and_removed() {
    let layout = Layout::default().with(Area::File(7), span(0, 5)).with(Area::File(3), span(2, 4));
    let files = |layout: &Layout| layout.areas().skip(4).collect::<Vec<_>>();
    assert_eq!(files(&layout), [Area::File(3), Area::File(7)]);
    let layout = layout.with(Area::File(3), span(0, 9));
    assert_eq!(layout.span(Area::File(3)), span(0, 9));
    assert_eq!(layout.bytes(Area::File(7), 0, 1), Some((4, 18..20)));
    let layout = layout.with(Area::File(3), span(0, 0));
    assert_eq!(files(&layout), [Area::File(7)]);
    assert_eq!(layout.bytes(Area::File(7), 0, 1), Some((4, 0..2)));
    assert!(layout.has_files());
    let layout = layout.with(Area::File(7), span(0, 0));
    assert!(!layout.has_files());
    assert_eq!(layout.byte_lens(), [0; 4]);
}

#[test]
fn a_span_has_its_bounds() {
    let span = span(100, 50);
    assert_eq!((span.start(), span.size(), span.end()), (100, 50, 150));
}

fn gated(mode: GateMode) -> Memory {
    let layout = Layout::default().with(Area::Coils, span(100, 50));
    Memory::new(layout, Some(Gate { area: Area::Coils, address: 111, mode })).unwrap()
}

#[test]
fn each_change_of_the_seal_is_counted() {
    let memory = gated(GateMode::Level);
    let mut changes = vec![memory.seal_changes()];
    for bit in [1, 1, 0, 0, 1, 0] {
        let write = Write { area: Area::Coils, address: 111, count: 1, bytes: &[bit] };
        memory.write(Access::Ingest, write).unwrap();
        changes.push(memory.seal_changes());
    }
    assert_eq!(changes, [(0, 0), (1, 0), (1, 0), (1, 1), (1, 1), (2, 1), (2, 2)]);
}

#[test]
fn after_a_restart_a_gate_that_opens_once_is_closed_and_one_with_a_level_is_as_its_bit() {
    for (mode, bytes, sealed, left) in [
        (GateMode::Once, [0xFF, 0xFF], true, [0xFF, 0xF7]),
        (GateMode::Level, [0xFF, 0xF7], true, [0xFF, 0xF7]),
        (GateMode::Level, [0x00, 0x08], false, [0x00, 0x08]),
    ] {
        let memory = gated(mode);
        let mut areas: Vec<Box<[u8]>> = vec![bytes.to_vec().into_boxed_slice()];
        let gate = memory.gate().unwrap();
        assert_eq!(gate.restore_seal(memory.layout(), &mut areas), sealed);
        assert_eq!(*areas[0], left);
    }
}

#[test]
fn a_queue_of_writes_has_room_for_4096_and_one_mebibyte_of_values() {
    let memory = Memory::new(Layout::default().with(REGISTERS, span(0, 65_536)), None).unwrap();
    let write = |bytes: &[u8]| {
        let write = Write { area: REGISTERS, address: 0, count: bytes.len() / 2, bytes };
        memory.write(Access::Ingest, write).unwrap();
    };
    let queue = memory.observe(false);
    (0..4097_u16).for_each(|number| write(&number.to_be_bytes()));
    assert_eq!(queue.dropped(), 1);
    assert_eq!(queue.next(Duration::ZERO).unwrap().bytes, [0, 1]);
    let queue = memory.observe(false);
    // Twice, because what was taken or dropped makes room.
    for dropped in [1, 2] {
        (0..9).for_each(|number| write(&[number; 128 * 1024]));
        assert_eq!(queue.dropped(), dropped);
        for number in 1..9 {
            assert_eq!(queue.next(Duration::ZERO).unwrap().bytes[0], number);
        }
        assert_eq!(queue.next(Duration::ZERO), None);
    }
    (0..8).for_each(|number| write(&[number; 128 * 1024]));
    queue.next(Duration::ZERO).unwrap();
    (8..10).for_each(|number| write(&[number; 128 * 1024]));
    assert_eq!(queue.dropped(), 3);
}

#[test]
fn ranges_that_mirror_a_device_do_not_change_the_seal() {
    let memory = gated(GateMode::Level);
    memory.mirror(vec![holdfast_memory::Mirrored::reserved(Area::Coils, 120, 3)]).unwrap();
    assert!(memory.sealed());
}

#[test]
fn a_client_never_writes_the_gate_bit_alone_or_as_the_first_or_last_of_others() {
    let memory = gated(GateMode::Level);
    let write = |access, address, count, bytes: &[u8]| {
        memory.write(access, Write { area: Area::Coils, address, count, bytes })
    };
    write(Access::Ingest, 111, 1, &[1]).unwrap();
    for (address, count, refused) in
        [(111, 1, true), (111, 9, true), (103, 9, true), (103, 8, false), (112, 9, false)]
    {
        let bytes = [0; 2];
        let done = write(Access::Client, address, count, &bytes[..count.div_ceil(8)]);
        let expected = if refused { Err(Refusal::GateBit) } else { Ok(()) };
        assert_eq!(done, expected, "{address} {count}");
        let passed = memory.check_passed(Access::Client, (Area::Coils, address, count));
        assert_eq!(passed, expected, "{address} {count}");
    }
}

#[test]
fn files_are_part_of_the_contents_that_are_copied_and_restored() {
    let file = Area::File(3);
    let layout = Layout::default().with(file, span(0, 2)).with(Area::File(9), span(0, 1));
    let [before, after] =
        [(); 2].map(|()| std::sync::Arc::new(Memory::new(layout.clone(), None).unwrap()));
    let write = Write { area: file, address: 1, count: 1, bytes: &[5, 6] };
    before.write(Access::Ingest, write).unwrap();
    let copied = Memory::contents(std::slice::from_ref(&before));
    assert_eq!(*copied[0].areas[4], [0, 0, 5, 6, 0, 0]);
    let writes = after.writes();
    after.restore(&copied[0]);
    assert_eq!(after.bytes(4, 2..4), [5, 6]);
    assert_eq!(after.writes(), writes + 1, "it counts as a write");
}

#[test]
fn a_large_batch_over_memories_and_areas_is_written_in_its_order() {
    let layout = || Layout::default().with(REGISTERS, span(0, 40)).with(Area::Coils, span(0, 40));
    let [one, other] = [(); 2].map(|()| Memory::new(layout(), None).unwrap());
    let values: Vec<[u8; 2]> = (0..20).map(|number| [1, number]).collect();
    let register = |address, bytes| Write { area: REGISTERS, address, count: 1, bytes };
    let writes: Vec<(&Memory, Write)> = values
        .iter()
        .zip(0..20)
        .flat_map(|(bytes, number)| {
            let coil = Write { area: Area::Coils, address: number, count: 1, bytes: &[1] };
            // The other memory gets each register twice: the later value stays.
            [
                (&one, register(2 * number, bytes)),
                (&other, register(number / 2, bytes)),
                (&other, coil),
            ]
        })
        .collect();
    holdfast_memory::write_across(Access::Ingest, &writes).unwrap();
    assert_eq!(one.bytes(2, 0..12), [1, 0, 0, 0, 1, 1, 0, 0, 1, 2, 0, 0]);
    assert_eq!(one.bytes(2, 76..80), [1, 19, 0, 0]);
    assert_eq!(one.bytes(0, 0..5), [0; 5]);
    assert_eq!(other.bytes(2, 0..8), [1, 1, 1, 3, 1, 5, 1, 7]);
    assert_eq!(other.bytes(2, 18..22), [1, 19, 0, 0]);
    assert_eq!(other.bytes(0, 0..5), [0xFF, 0xFF, 0x0F, 0, 0]);
}
