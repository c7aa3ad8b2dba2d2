//! Steps survive their encoding, and no bytes do harm.

use std::sync::Arc;

use holdfast_journal::encoding::{DecodeError, VERSION, decode, encode};
use holdfast_memory::{
    Access, Action, Area, Layout, Memory, Refusal, Refused, Span, Step, StepWrite, Tenure, Term,
};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proptest::sample::select;

/// The first address and the size of each area, for two memories.
const SPANS: [[(u16, u32); 4]; 2] =
    [[(0, 65_536), (7, 20), (100, 300), (0, 1)], [(0, 9), (0, 0), (65_530, 6), (3, 70)]];

/// Files of both memories, with their numbers of records.
const FILES: [(u16, u32); 2] = [(4, 300), (u16::MAX, 1)];

fn span(member: u16, area: Area) -> (u16, u32) {
    let file = |number| FILES.iter().find(|(other, _)| *other == number).unwrap().1;
    match area {
        Area::File(number) => (0, file(number)),
        area => SPANS[usize::from(member)][area.index()],
    }
}

fn members() -> Vec<Arc<Memory>> {
    SPANS
        .map(|spans| {
            let layout =
                Area::ALL.into_iter().zip(spans).fold(Layout::default(), |layout, (area, span)| {
                    layout.with(area, Span::new(span.0, span.1).unwrap())
                });
            let layout = FILES.iter().fold(layout, |layout, (number, records)| {
                layout.with(Area::File(*number), Span::new(0, *records).unwrap())
            });
            Arc::new(Memory::new(layout, None).unwrap())
        })
        .to_vec()
}

fn access() -> impl Strategy<Value = Access> {
    select(vec![Access::Client, Access::Ingest, Access::Mirror, Access::Restore])
}

/// A range inside an area: member, area, address, count.
fn range(member: u16, areas: &'static [Area]) -> impl Strategy<Value = (u16, Area, u16, usize)> {
    let existing = areas.iter().filter(|area| span(member, **area).1 > 0).collect::<Vec<_>>();
    select(existing).prop_flat_map(move |area| {
        let (start, size) = span(member, *area);
        (0..size, 0..size).prop_map(move |(one, other)| {
            let (first, last) = (one.min(other), one.max(other));
            (member, *area, start + first as u16, (last - first + 1) as usize)
        })
    })
}

const ALL: &[Area] = &[
    Area::Coils,
    Area::DiscreteInputs,
    Area::HoldingRegisters,
    Area::InputRegisters,
    Area::File(4),
    Area::File(u16::MAX),
];
const REGISTERS: &[Area] = &[Area::HoldingRegisters, Area::InputRegisters, Area::File(4)];

fn write_to(member: u16) -> impl Strategy<Value = StepWrite> {
    range(member, ALL).prop_flat_map(|(member, area, address, count)| {
        let len = area.byte_len(count);
        vec(any::<u8>(), len).prop_map(move |bytes| StepWrite {
            member,
            area,
            address,
            count,
            bytes,
        })
    })
}

fn action() -> impl Strategy<Value = Action> {
    let member = || 0..SPANS.len() as u16;
    prop_oneof![
        vec(member().prop_flat_map(write_to), 0..4).prop_map(Action::Write),
        (member().prop_flat_map(|member| range(member, REGISTERS)), any::<(u16, u16)>()).prop_map(
            |((member, area, address, _), (and_mask, or_mask))| Action::Mask {
                member,
                area,
                address,
                and_mask,
                or_mask
            }
        ),
        member().prop_flat_map(|member| (write_to(member), range(member, ALL))).prop_map(
            |(write, (_, area, address, count))| Action::WriteThenRead {
                write,
                area,
                address,
                count
            }
        ),
    ]
}

fn step() -> impl Strategy<Value = Step> {
    let tenure = option::of(any::<[u64; 3]>()).prop_map(|tenure| {
        tenure.map(|[lease, epoch, since]| Tenure { lease, term: Term { epoch, since } })
    });
    (access(), tenure, action()).prop_map(|(access, tenure, action)| Step {
        access,
        tenure,
        action,
    })
}

fn written(access: Access, action: Action) -> Step {
    Step { access, tenure: None, action }
}

fn encoded(step: &Step) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode(step, &mut bytes);
    bytes
}

proptest! {
    #[test]
    fn a_step_is_decoded_as_it_was(step in step()) {
        prop_assert_eq!(decode(&encoded(&step), &members()), Ok(step));
    }

    #[test]
    fn any_bytes_are_a_step_or_an_error(bytes in vec(any::<u8>(), 0..200)) {
        let _ = decode(&bytes, &members());
    }

    /// Changed bytes are a step that the memories can carry out, or an error.
    #[test]
    fn changed_bytes_are_a_step_for_the_memories_or_an_error(
        step in step(),
        changes in vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
    ) {
        let mut bytes = encoded(&step);
        for (index, byte) in changes {
            let at = index.index(bytes.len().min(40));
            bytes[at] = byte;
        }
        let members = members();
        if let Ok(step) = decode(&bytes, &members) {
            // None of the memories is sealed.
            let is_sealed_out = |refused: &Refused| {
                step.access == Access::Restore && refused.refusal == Refusal::Unsealed
            };
            let refused = step.carry_out(&members).err();
            prop_assert!(refused.as_ref().is_none_or(is_sealed_out), "{:?}", refused);
            prop_assert_eq!(encoded(&step), bytes);
        }
    }

    #[test]
    fn a_part_of_a_step_is_an_error_or_shorter(step in step(), part in any::<prop::sample::Index>()) {
        let bytes = encoded(&step);
        let part = &bytes[..part.index(bytes.len())];
        // A list of writes may end behind each of them.
        if let Ok(shorter) = decode(part, &members()) {
            prop_assert_eq!(encoded(&shorter), part);
            prop_assert!(matches!(shorter.action, Action::Write(_)));
        }
    }
}

fn register(member: u16, address: u16) -> StepWrite {
    StepWrite { member, area: Area::HoldingRegisters, address, count: 1, bytes: vec![1, 2] }
}

#[test]
fn members_and_ranges_are_checked_against_the_memories() {
    let of = |action| decode(&encoded(&written(Access::Client, action)), &members());
    let area = Area::HoldingRegisters;
    let outside = |address| DecodeError::Range { member: 0, area, address, count: 1 };
    assert_eq!(of(Action::Write(vec![register(2, 100)])), Err(DecodeError::Member(2)));
    assert_eq!(of(Action::Write(vec![register(0, 99)])), Err(outside(99)));
    assert_eq!(of(Action::Write(vec![register(0, 400)])), Err(outside(400)));
    let mask = |area, address| Action::Mask { member: 0, area, address, and_mask: 0, or_mask: 0 };
    assert_eq!(of(mask(area, 400)), Err(outside(400)));
    assert_eq!(of(mask(Area::Coils, 0)), Err(DecodeError::Mask(Area::Coils)));
    let read = |address| Action::WriteThenRead { write: register(0, 100), area, address, count: 1 };
    assert_eq!(of(read(99)), Err(outside(99)));
    assert!(of(read(100)).is_ok());
}

#[test]
fn errors_name_what_is_wrong() {
    let members = members();
    let good = encoded(&written(Access::Ingest, Action::Write(vec![register(0, 100)])));
    let with = |at: usize, byte| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        decode(&bytes, &members)
    };
    assert_eq!(with(0, VERSION + 1), Err(DecodeError::Version(VERSION + 1)));
    assert_eq!(with(1, 9), Err(DecodeError::Unknown { what: "the access", found: 9 }));
    assert_eq!(with(2, 9), Err(DecodeError::Unknown { what: "the action", found: 9 }));
    assert_eq!(with(5, 9), Err(DecodeError::Unknown { what: "the area", found: 9 }));
    assert_eq!(decode(&good[..good.len() - 1], &members), Err(DecodeError::Short));
    let mask =
        Action::Mask { member: 0, area: Area::InputRegisters, address: 0, and_mask: 1, or_mask: 2 };
    let mut long = encoded(&written(Access::Client, mask));
    long.push(0);
    assert_eq!(decode(&long, &members), Err(DecodeError::Long(1)));
    assert_eq!(decode(&[], &members), Err(DecodeError::Short));
}
