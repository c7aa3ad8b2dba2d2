//! Followers see what has changed, observers see every write.

use std::sync::Arc;
use std::time::Duration;

use holdfast_memory::{
    Access, Area, Change, Follower, Layout, Memory, Refusal, Span, Write, Written, write_across,
};

const REGISTERS: Area = Area::HoldingRegisters;
const SOON: Duration = Duration::from_secs(20);

fn memory() -> Arc<Memory> {
    let layout = Layout::default()
        .with(REGISTERS, Span::new(10, 100).unwrap())
        .with(Area::Coils, Span::new(0, 40).unwrap());
    Arc::new(Memory::new(layout, None).unwrap())
}

fn write(memory: &Memory, area: Area, address: u16, count: usize, bytes: &[u8]) {
    memory.write(Access::Ingest, Write { area, address, count, bytes }).unwrap();
}

fn change(range: usize, area: Area, address: u16, count: usize, bytes: &[u8]) -> Change {
    Change { range, area, address, count, bytes: bytes.to_vec() }
}

#[test]
fn the_first_look_is_everything_and_later_ones_are_the_changed_parts() {
    let memory = memory();
    write(&memory, REGISTERS, 12, 1, &[1, 2]);
    let ranges = [(REGISTERS, 11, 4), (Area::Coils, 3, 20)];
    let mut follower = Follower::new(Arc::clone(&memory), ranges).unwrap();
    let (first, all) = follower.changes().unwrap();
    assert_eq!(
        all,
        [
            change(0, REGISTERS, 11, 4, &[0, 0, 1, 2, 0, 0, 0, 0]),
            change(1, Area::Coils, 3, 20, &[0, 0, 0])
        ]
    );
    assert_eq!(follower.changes().unwrap(), (first, vec![]));
    write(&memory, REGISTERS, 12, 3, &[1, 2, 0, 9, 0, 8]);
    write(&memory, Area::Coils, 0, 16, &[0x07, 0x84]);
    let (second, parts) = follower.changes().unwrap();
    assert!(second > first);
    // Coils 10 and 15 are set: ten, four zeros, fifteen.
    let expected =
        [change(0, REGISTERS, 13, 2, &[0, 9, 0, 8]), change(1, Area::Coils, 10, 6, &[0x21])];
    assert_eq!(parts, expected);
    assert_eq!(follower.changes().unwrap(), (second, vec![]));
}

#[test]
fn a_write_that_changes_nothing_or_elsewhere_is_counted_and_no_change() {
    let memory = memory();
    let mut follower = Follower::new(Arc::clone(&memory), [(REGISTERS, 11, 4)]).unwrap();
    let (first, _) = follower.changes().unwrap();
    write(&memory, REGISTERS, 11, 1, &[0, 0]);
    write(&memory, REGISTERS, 15, 1, &[7, 7]);
    assert_eq!(follower.changes().unwrap(), (first + 2, vec![]));
    write(&memory, REGISTERS, 14, 1, &[7, 7]);
    write(&memory, REGISTERS, 14, 1, &[0, 0]);
    assert_eq!(follower.changes().unwrap(), (first + 4, vec![]));
}

#[test]
fn every_way_to_write_is_seen() {
    let memory = memory();
    let mut follower = Follower::new(Arc::clone(&memory), [(REGISTERS, 10, 3)]).unwrap();
    follower.changes().unwrap();
    memory.mask_write(Access::Client, REGISTERS, 10, 0, 0x0102).unwrap();
    assert_eq!(follower.changes().unwrap().1, [change(0, REGISTERS, 10, 1, &[1, 2])]);
    let one = Write { area: REGISTERS, address: 11, count: 1, bytes: &[3, 4] };
    write_across(Access::Ingest, &[(&memory, one)]).unwrap();
    assert_eq!(follower.changes().unwrap().1, [change(0, REGISTERS, 11, 1, &[3, 4])]);
}

#[test]
fn a_range_outside_its_area_can_not_be_followed() {
    for (address, count, refusal) in
        [(9, 1, Refusal::OutOfRange), (109, 2, Refusal::OutOfRange), (10, 0, Refusal::WrongLength)]
    {
        let ranges = [(REGISTERS, 10, 1), (REGISTERS, address, count)];
        let refused = Follower::new(memory(), ranges).unwrap_err();
        assert_eq!((refused.index, refused.refusal), (1, refusal));
    }
}

#[test]
fn observers_get_writes_in_order_and_only_those_they_want() {
    let memory = memory();
    let (all, clients) = (memory.observe(false), memory.observe(true));
    write(&memory, REGISTERS, 10, 1, &[1, 1]);
    memory.mask_write(Access::Client, REGISTERS, 10, 0xFF00, 0x0002).unwrap();
    let refused = Write { area: REGISTERS, address: 9, count: 1, bytes: &[5, 5] };
    memory.write(Access::Client, refused).unwrap_err();
    let written = |bytes: &[u8]| {
        Some(Written { area: REGISTERS, address: 10, count: 1, bytes: bytes.to_vec() })
    };
    assert_eq!(all.next(SOON), written(&[1, 1]));
    assert_eq!(all.next(SOON), written(&[1, 2]));
    assert_eq!(all.next(Duration::ZERO), None);
    assert_eq!(clients.next(SOON), written(&[1, 2]));
    assert_eq!(clients.next(Duration::ZERO), None);
}

#[test]
fn a_full_queue_drops_the_oldest_writes_and_counts_them() {
    let memory = memory();
    let queue = memory.observe(false);
    for number in 0..5000_u16 {
        write(&memory, REGISTERS, 10, 1, &number.to_be_bytes());
    }
    let dropped = queue.dropped();
    assert!(dropped > 0);
    let next = queue.next(SOON).unwrap();
    assert_eq!(u64::from(u16::from_be_bytes([next.bytes[0], next.bytes[1]])), dropped);
}

#[test]
fn a_queue_ends_with_its_memory_and_when_it_is_closed() {
    let (kept, dropped) = (memory(), memory());
    let (first, second) = (kept.observe(false), dropped.observe(false));
    first.close();
    write(&kept, REGISTERS, 10, 1, &[1, 1]);
    drop(dropped);
    for queue in [first, second] {
        assert!(queue.is_closed());
        assert_eq!(queue.next(SOON), None);
    }
}
