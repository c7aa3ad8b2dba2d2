//! Tests broadcasts and listen only mode, and their counters.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};

use holdfast_engine::items::Items;
use holdfast_engine::server::reports::counters::Bus;
use holdfast_engine::server::requests::identity::Identity;
use holdfast_engine::server::requests::unit_server::{UnitServer, UnitSettings};
use holdfast_engine::server::rights::functions::{AccessMode, Functions};
use holdfast_engine::server::rights::peer_rights::PeerRights;
use holdfast_engine::server::rights::ranges::Ranges;
use holdfast_engine::server::rights::rule::{Narrowed, Rule};
use holdfast_memory::{
    Access, Area, CarriedOut, Done, Gate, GateMode, Journal, Layout, Memory, Refusal, Refused,
    Span, Step, Write,
};
use holdfast_protocol::pdu;

const READ: &[u8] = &[3, 0, 0, 0, 1];
const WRITE: &[u8] = &[6, 0, 0, 0x12, 0x34];
const LISTEN_ONLY: &[u8] = &[8, 0, 4, 0, 0];
const RESTART: &[u8] = &[8, 0, 1, 0, 0];
const CLEAR_COUNTERS: &[u8] = &[8, 0, 10, 0, 0];

fn memory(registers: u32) -> Arc<Memory> {
    let span = Span::new(0, registers).unwrap();
    Arc::new(Memory::new(Layout::default().with(Area::HoldingRegisters, span), None).unwrap())
}

fn rights(units: &[(u8, &Arc<Memory>)], rights: AccessMode) -> PeerRights {
    let units = units.iter().map(|(unit_id, memory)| (*unit_id, Arc::clone(memory))).collect();
    PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units,
        destinations: Vec::new(),
        access: rights,
        functions: Functions::All,
        narrowed: Vec::new(),
    })
}

/// Rights for unit 7, within ranges of holding registers: address and count.
fn within(memory: &Arc<Memory>, read: &[(u16, u32)], write: &[(u16, u32)]) -> PeerRights {
    let items = |ranges: &[(u16, u32)]| {
        let area = Area::HoldingRegisters;
        Some(
            ranges
                .iter()
                .map(|(address, count)| Items { area, address: *address, count: *count })
                .collect(),
        )
    };
    let own = Narrowed {
        access: AccessMode::ReadWrite,
        functions: Functions::Except(vec![4]),
        ranges: Ranges::new(items(read), items(write)),
        exception_status: None,
        queues: Box::default(),
    };
    PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units: vec![(7, Arc::clone(memory)), (8, Arc::clone(memory))],
        destinations: Vec::new(),
        access: AccessMode::ReadOnly,
        functions: Functions::All,
        narrowed: vec![(7, own)],
    })
}

fn unit_server() -> UnitServer {
    unit_server_with(true)
}

fn unit_server_with(listen_only: bool) -> UnitServer {
    let objects = [(0, b"a".to_vec()), (1, b"b".to_vec()), (2, b"c".to_vec())];
    UnitServer::new(
        Identity::new(&objects, &[]).unwrap(),
        UnitSettings { listen_only, ..UnitSettings::default() },
    )
}

fn ask(
    unit_server: &UnitServer,
    rights: &PeerRights,
    unit_id: u8,
    request: &[u8],
) -> Option<Vec<u8>> {
    let mut reply = [0; pdu::MAX_LEN];
    let len = unit_server.answer(rights, unit_id, request, || true, &mut reply)?;
    Some(reply[..len].to_vec())
}

fn broadcast(unit_server: &UnitServer, rights: &PeerRights, request: &[u8]) -> Vec<Vec<u8>> {
    let noted = broadcast_if(unit_server, rights, request, Some(()));
    noted.into_iter().map(|(reply, _, _)| reply).collect()
}

/// A reply, where a log has the write, and the permit.
type Noted = (Vec<u8>, Option<u64>, Option<()>);

fn broadcast_if(
    unit_server: &UnitServer,
    rights: &PeerRights,
    request: &[u8],
    permit: Option<()>,
) -> Vec<Noted> {
    let mut noted = Vec::new();
    let note = |_: Option<&Memory>, reply: &[u8], sequence, permit| {
        noted.push((reply.to_vec(), sequence, permit));
    };
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    runtime.block_on(unit_server.broadcast(rights, request, || permit, note));
    noted
}

#[test]
fn a_broadcast_to_several_memories_counts_as_one_message() {
    let (one, other, unit_server) = (memory(1), memory(1), unit_server());
    let rights = rights(&[(7, &one), (8, &other), (9, &one)], AccessMode::ReadWrite);
    assert_eq!(broadcast(&unit_server, &rights, WRITE), [WRITE, WRITE]);
    assert_eq!(
        unit_server.counters.bus(),
        Bus { messages: 1, server_messages: 1, no_response: 1, events: 1, ..Bus::default() }
    );
    for unit_id in [7, 8] {
        assert_eq!(ask(&unit_server, &rights, unit_id, READ).unwrap(), [3, 2, 0x12, 0x34]);
    }
}

#[test]
fn a_broadcast_that_some_memories_refuse_counts_one_exception_and_no_event() {
    let (one, other, small) = (memory(9), memory(1), memory(2));
    let unit_server = unit_server();
    let rights = rights(&[(7, &one), (8, &other), (9, &small)], AccessMode::ReadWrite);
    let replies = broadcast(&unit_server, &rights, &[6, 0, 5, 0, 1]);
    assert_eq!(replies, [vec![6, 0, 5, 0, 1], vec![0x86, 2], vec![0x86, 2]]);
    let bus = unit_server.counters.bus();
    assert_eq!((bus.exceptions, bus.events, bus.no_response), (1, 0, 1));
}

#[test]
fn a_broadcast_reaches_a_memory_by_the_unit_that_may_write() {
    let (unit_server, shared) = (unit_server(), memory(9));
    // Unit 7 may write registers 0 to 3, unit 8 none.
    let rights = within(&shared, &[(0, 9)], &[(0, 4)]);
    assert_eq!(broadcast(&unit_server, &rights, WRITE), [WRITE]);
    assert_eq!(broadcast(&unit_server, &rights, &[6, 0, 5, 0, 1]), [[0x86, 2]]);

    let own = Narrowed {
        access: AccessMode::ReadOnly,
        functions: Functions::All,
        ranges: Ranges::default(),
        exception_status: None,
        queues: Box::default(),
    };
    let rights = PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units: vec![(1, Arc::clone(&shared)), (2, Arc::clone(&shared))],
        destinations: Vec::new(),
        access: AccessMode::ReadWrite,
        functions: Functions::All,
        narrowed: vec![(1, own)],
    });
    assert_eq!(broadcast(&unit_server, &rights, WRITE), [WRITE]);
}

#[test]
fn a_broadcast_skips_units_in_listen_only_mode() {
    let (one, other, unit_server) = (memory(1), memory(1), unit_server());
    let rights = rights(&[(7, &one), (8, &other), (9, &other)], AccessMode::ReadWrite);
    for unit_id in [7, 8] {
        assert_eq!(ask(&unit_server, &rights, unit_id, LISTEN_ONLY), None);
    }
    assert_eq!(broadcast(&unit_server, &rights, WRITE), [WRITE]);
    assert_eq!(ask(&unit_server, &rights, 9, READ).unwrap(), [3, 2, 0x12, 0x34]);
    assert_eq!(ask(&unit_server, &rights, 7, RESTART), None);
    assert_eq!(ask(&unit_server, &rights, 7, READ).unwrap(), [3, 2, 0, 0]);
}

#[test]
fn a_unit_in_listen_only_mode_does_not_answer_denied_requests() {
    let (memory, unit_server) = (memory(1), unit_server());
    let all = rights(&[(7, &memory)], AccessMode::ReadWrite);
    let read_only = rights(&[(7, &memory)], AccessMode::ReadOnly);
    let elsewhere = rights(&[(8, &memory)], AccessMode::ReadWrite);
    assert_eq!(ask(&unit_server, &all, 7, LISTEN_ONLY), None);
    assert_eq!(ask(&unit_server, &all, 7, &[99]), None);
    for request in [WRITE, RESTART, &[43, 13, 0, 0]] {
        assert_eq!(ask(&unit_server, &read_only, 7, request), None);
    }
    assert_eq!(ask(&unit_server, &all, 7, READ), None);
    assert_eq!(ask(&unit_server, &elsewhere, 7, READ).unwrap(), [0x83, 0x0B]);
    assert_eq!(ask(&unit_server, &elsewhere, 7, &[99]).unwrap(), [0xE3, 1]);
    assert_eq!(ask(&unit_server, &all, 7, RESTART), None);
    assert_eq!(ask(&unit_server, &all, 7, READ).unwrap(), [3, 2, 0, 0]);
}

#[test]
fn listen_only_mode_is_refused_unless_the_listener_allows_it() {
    let (memory, unit_server) = (memory(1), unit_server_with(false));
    let rights = rights(&[(7, &memory)], AccessMode::ReadWrite);
    for request in [LISTEN_ONLY, &[8, 0, 4], &[8, 0, 4, 0, 1]] {
        assert_eq!(ask(&unit_server, &rights, 7, request).unwrap(), [0x88, 1]);
        // The unit id is not looked up.
        assert_eq!(ask(&unit_server, &rights, 9, request).unwrap(), [0x88, 1]);
    }
    assert_eq!(ask(&unit_server, &rights, 7, READ).unwrap(), [3, 2, 0, 0]);
    assert_eq!(ask(&unit_server, &rights, 7, RESTART).unwrap(), RESTART);
}

#[test]
fn damaged_frames_count_as_errors_not_as_messages() {
    let unit_server = unit_server();
    unit_server.counters.frames.damaged.add_many(3);
    unit_server.counters.frames.other_unit.add_many(2);
    assert_eq!(
        unit_server.counters.bus(),
        Bus { messages: 2, communication_errors: 3, ..Bus::default() }
    );
}

#[test]
fn a_unit_can_have_ranges_and_functions_of_its_own() {
    let (memory, unit_server) = (memory(100), unit_server());
    // Two ranges that meet are one.
    let rights = within(&memory, &[(0, 10), (10, 10)], &[(15, 10)]);
    let ask = |unit: u8, pdu: &[u8]| ask(&unit_server, &rights, unit, pdu).unwrap();
    let refused = |code: u8| vec![code | 0x80, 2];
    assert_eq!(ask(7, &[3, 0, 5, 0, 10])[..2], [3, 20]);
    assert_eq!(ask(7, &[3, 0, 15, 0, 6]), refused(3));
    assert_eq!(ask(7, &[6, 0, 15, 0, 1]), [6, 0, 15, 0, 1]);
    assert_eq!(ask(7, &[6, 0, 14, 0, 1]), refused(6));
    assert_eq!(ask(7, &[22, 0, 25, 0, 1, 0, 1]), refused(22));
    assert_eq!(ask(7, &[16, 0, 24, 0, 2, 4, 0, 1, 0, 1]), refused(16));
    assert_eq!(ask(7, &[23, 0, 0, 0, 1, 0, 15, 0, 1, 2, 0, 1])[..2], [23, 2]);
    assert_eq!(ask(7, &[23, 0, 20, 0, 1, 0, 15, 0, 1, 2, 0, 1]), refused(23));
    assert_eq!(ask(7, &[23, 0, 0, 0, 1, 0, 14, 0, 1, 2, 0, 1]), refused(23));
    assert_eq!(ask(7, &[4, 0, 0, 0, 1]), [0x84, 1]);
    // The other unit has the rights of the rule.
    assert_eq!(ask(8, &[3, 0, 50, 0, 1])[..2], [3, 2]);
    assert_eq!(ask(8, &[6, 0, 15, 0, 1]), [0x86, 1]);
    let registers = ask(8, &[3, 0, 14, 0, 2]);
    assert_eq!(registers, [3, 4, 0, 0, 0, 1]);
}

#[test]
fn a_sealed_memory_does_not_show_which_ranges_a_peer_has() {
    let layout = Layout::default()
        .with(Area::HoldingRegisters, Span::new(0, 10).unwrap())
        .with(Area::Coils, Span::new(0, 1).unwrap());
    let gate = Gate { area: Area::Coils, address: 0, mode: GateMode::Once };
    let memory = Arc::new(Memory::new(layout, Some(gate)).unwrap());
    let rights = within(&memory, &[(0, 1)], &[]);
    for address in [0, 5] {
        let reply = ask(&unit_server(), &rights, 7, &[3, 0, address, 0, 1]);
        assert_eq!(reply.unwrap(), [0x83, 6]);
    }
}

#[test]
fn a_write_that_is_not_permitted_is_refused_after_rights_and_form_and_before_the_memory() {
    let (one, unit_server) = (memory(1), unit_server());
    let rights = rights(&[(7, &one)], AccessMode::ReadWrite);
    let refused = |unit_id, request: &[u8]| {
        let mut reply = [0; pdu::MAX_LEN];
        let len = unit_server.answer(&rights, unit_id, request, || false, &mut reply).unwrap();
        (reply[0] >= 0x80).then(|| reply[..len][1])
    };
    assert_eq!(refused(7, WRITE), Some(4));
    assert_eq!(refused(9, WRITE), Some(0x0B));
    assert_eq!(refused(7, &WRITE[..3]), Some(3));
    assert_eq!(refused(7, &[0x41]), Some(1));
    let before = ask(&unit_server, &rights, 7, READ);
    let replies = broadcast_if(&unit_server, &rights, WRITE, None);
    assert_eq!(replies, [(vec![WRITE[0] | 0x80, 4], None, None)]);
    assert_eq!(ask(&unit_server, &rights, 7, READ), before);
}

#[test]
fn a_write_that_a_peer_may_not_send_takes_no_room_in_the_audit_log() {
    let (one, unit_server) = (memory(1), unit_server());
    let read_only = rights(&[(7, &one)], AccessMode::ReadOnly);
    let read_write = rights(&[(7, &one)], AccessMode::ReadWrite);
    let outside = within(&one, &[(0, 1)], &[(5, 1)]);
    let mut reply = [0; pdu::MAX_LEN];
    for (rights, unit_id) in [(&read_only, 7), (&read_write, 9), (&outside, 7)] {
        let unasked = || panic!("the permit takes room");
        unit_server.answer(rights, unit_id, WRITE, unasked, &mut reply).unwrap();
        assert_eq!(reply[0], WRITE[0] | 0x80);
    }
}

/// Carries out each step at once, at the next sequence from 7 on, or refuses it.
#[derive(Debug)]
struct AtOnce {
    refusal: Option<Refusal>,
    sequence: AtomicU64,
    members: Weak<Memory>,
}

impl Journal for AtOnce {
    fn submit(&self, step: Step, done: Done) {
        let carried_out = step.carry_out(&[self.members.upgrade().unwrap()]);
        let sequence = Some(self.sequence.fetch_add(1, Ordering::Relaxed));
        done(match self.refusal {
            None => carried_out.map(|carried_out| CarriedOut { sequence, ..carried_out }),
            Some(refusal) => Err(Refused { index: 0, refusal }),
        });
    }
}

#[test]
fn a_broadcast_waits_for_journals_and_is_recorded_with_their_sequences() {
    let (kept, refusing, plain) = (memory(1), memory(1), memory(1));
    for (memory, refusal) in [(&kept, None), (&refusing, Some(Refusal::NotStored))] {
        let (sequence, members) = (AtomicU64::new(7), Arc::downgrade(memory));
        memory.keep_in(Arc::new(AtOnce { refusal, sequence, members }), 0);
    }
    let unit_server = unit_server();
    let units = [(7, &kept), (8, &refusing), (9, &plain)];
    let replies =
        broadcast_if(&unit_server, &rights(&units, AccessMode::ReadWrite), WRITE, Some(()));
    let (done, refused) = (WRITE.to_vec(), vec![WRITE[0] | 0x80, 4]);
    let expected =
        [(done.clone(), Some(7), Some(())), (refused, None, Some(())), (done, None, Some(()))];
    assert_eq!(replies, expected);
    assert_eq!((unit_server.counters.bus().exceptions, unit_server.counters.bus().events), (1, 0));
    let read_only = rights(&[(7, &kept)], AccessMode::ReadOnly);
    let refused = (vec![WRITE[0] | 0x80, 1], None, None);
    assert_eq!(broadcast_if(&unit_server, &read_only, WRITE, Some(())), [refused]);
}

/// Unit 7 has function 7 with coils 4 to 11, unit 8 does not have it.
fn with_status(memory: &Arc<Memory>, functions: Functions, read: Option<Vec<Items>>) -> PeerRights {
    let own = Narrowed {
        access: AccessMode::ReadOnly,
        functions,
        ranges: Ranges::new(read, None),
        exception_status: Some((Area::Coils, 4)),
        queues: Box::default(),
    };
    PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units: vec![(7, Arc::clone(memory)), (8, Arc::clone(memory))],
        destinations: Vec::new(),
        access: AccessMode::ReadOnly,
        functions: Functions::All,
        narrowed: vec![(7, own)],
    })
}

fn coils(count: u32, seal: Option<Gate>) -> Arc<Memory> {
    let layout = Layout::default().with(Area::Coils, Span::new(0, count).unwrap());
    Arc::new(Memory::new(layout, seal).unwrap())
}

const STATUS: &[u8] = &[7];
const EVENT_LOG: &[u8] = &[12];

#[test]
fn function_7_reads_eight_bits_where_a_unit_has_them() {
    let (memory, unit_server) = (coils(16, None), unit_server());
    let bits = Write { area: Area::Coils, address: 0, count: 12, bytes: &[0b1101_1111, 0b1010] };
    memory.write(Access::Ingest, bits).unwrap();
    let rights = with_status(&memory, Functions::All, None);
    assert_eq!(ask(&unit_server, &rights, 7, STATUS).unwrap(), [7, 0b1010_1101]);
    assert_eq!(ask(&unit_server, &rights, 7, &[7, 0]).unwrap(), [0x87, 3]);
    assert_eq!(ask(&unit_server, &rights, 8, STATUS).unwrap(), [0x87, 1]);
    assert_eq!(ask(&unit_server, &rights, 9, STATUS).unwrap(), [0x87, 0x0B]);
}

#[test]
fn function_7_has_the_checks_of_a_read() {
    let unit_server = unit_server();
    let all = coils(16, None);
    let items = |address, count| Some(vec![Items { area: Area::Coils, address, count }]);
    for (memory, functions, read, reply) in [
        (&all, Functions::Except(vec![7]), None, [0x87, 1]),
        (&all, Functions::Only(vec![7]), items(4, 8), [7, 0]),
        (&all, Functions::All, items(5, 8), [0x87, 2]),
        (&coils(11, None), Functions::All, None, [0x87, 2]),
        (
            &coils(16, Some(Gate { area: Area::Coils, address: 0, mode: GateMode::Level })),
            Functions::All,
            None,
            [0x87, 6],
        ),
    ] {
        let rights = with_status(memory, functions, read);
        assert_eq!(ask(&unit_server, &rights, 7, STATUS).unwrap(), reply);
    }
}

#[test]
fn a_peer_learns_nothing_of_units_by_a_function_that_it_does_not_have() {
    let (memory, unit_server) = (coils(16, None), unit_server());
    let plain = rights(&[(7, &memory)], AccessMode::ReadWrite);
    for function in [STATUS, EVENT_LOG] {
        let refused = [function[0] | 0x80, 1];
        assert_eq!(ask(&unit_server, &plain, 7, function).unwrap(), refused);
        assert_eq!(ask(&unit_server, &plain, 9, function).unwrap(), refused);
    }
}

#[test]
fn a_peer_learns_nothing_of_units_by_a_sub_function_that_it_does_not_have() {
    let (memory, unit_server) = (memory(1), unit_server());
    for (functions, code) in [(Functions::Except(vec![8]), 1), (Functions::Only(vec![8]), 0x0B)] {
        let own = Narrowed {
            access: AccessMode::ReadWrite,
            functions,
            ranges: Ranges::new(None, None),
            exception_status: None,
            queues: Box::default(),
        };
        let rights = PeerRights::new(&Rule {
            sources: Vec::new(),
            roles: None,
            units: vec![(7, Arc::clone(&memory)), (8, Arc::clone(&memory))],
            destinations: Vec::new(),
            access: AccessMode::ReadOnly,
            functions: Functions::All,
            narrowed: vec![(7, own)],
        });
        assert_eq!(ask(&unit_server, &rights, 8, CLEAR_COUNTERS).unwrap(), [0x88, 1]);
        assert_eq!(ask(&unit_server, &rights, 9, CLEAR_COUNTERS).unwrap(), [0x88, code]);
        assert_eq!(ask(&unit_server, &rights, 9, &[8, 0, 0, 0, 0]).unwrap(), [0x88, 0x0B]);
    }
}

fn logging() -> UnitServer {
    let objects = [(0, b"a".to_vec()), (1, b"b".to_vec()), (2, b"c".to_vec())];
    let settings = UnitSettings { listen_only: true, event_log: true };
    UnitServer::new(Identity::new(&objects, &[]).unwrap(), settings)
}

/// Event count, message count and the events of function 12, without the request for them.
fn event_log(unit_server: &UnitServer, rights: &PeerRights) -> (u8, u8, Vec<u8>) {
    let reply = ask(unit_server, rights, 8, EVENT_LOG).unwrap();
    let [12, count, 0, 0, 0, events, 0, messages, 0x80, ref log @ ..] = reply[..] else {
        panic!("{reply:?}")
    };
    assert_eq!(usize::from(count), reply.len() - 2);
    (events, messages, log.to_vec())
}

#[test]
fn function_12_has_what_came_and_what_went() {
    let (memory, unit_server) = (memory(1), logging());
    let rights = rights(&[(7, &memory), (8, &memory)], AccessMode::ReadWrite);
    assert_eq!(event_log(&unit_server, &rights), (0, 1, vec![]));
    ask(&unit_server, &rights, 7, READ);
    ask(&unit_server, &rights, 7, &[3, 0, 9, 0, 1]);
    broadcast(&unit_server, &rights, WRITE);
    let expected = vec![0x40, 0xC0, 0x41, 0x80, 0x40, 0x80, 0x40, 0x80];
    assert_eq!(event_log(&unit_server, &rights), (3, 5, expected));
    assert_eq!(ask(&unit_server, &rights, 8, &[12, 0]).unwrap(), [0x8C, 3]);
}

#[test]
fn function_12_has_when_a_unit_became_silent_and_when_it_was_restarted() {
    let (memory, unit_server) = (memory(1), logging());
    let rights = rights(&[(7, &memory), (8, &memory)], AccessMode::ReadWrite);
    ask(&unit_server, &rights, 7, LISTEN_ONLY);
    ask(&unit_server, &rights, 7, READ);
    ask(&unit_server, &rights, 7, RESTART);
    let events = vec![0x00, 0x60, 0xA0, 0x60, 0xA0, 0x60, 0x04, 0x80];
    assert_eq!(event_log(&unit_server, &rights).2, events);
    // A restart that is refused is none.
    ask(&unit_server, &rights, 7, &[8, 0, 1, 0, 1]);
    assert_eq!(event_log(&unit_server, &rights).2[..3], [0x41, 0x80, 0x40]);
    // The reply is before the restart, which forgets it.
    ask(&unit_server, &rights, 7, &[8, 0, 1, 0xFF, 0]);
    assert_eq!(event_log(&unit_server, &rights).2, [0x00]);
}

#[test]
fn function_12_is_refused_where_a_rule_denies_it() {
    let (memory, unit_server) = (memory(1), logging());
    let rights = PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units: vec![(7, Arc::clone(&memory))],
        destinations: Vec::new(),
        access: AccessMode::ReadOnly,
        functions: Functions::Except(vec![12]),
        narrowed: Vec::new(),
    });
    for unit_id in [7, 9] {
        assert_eq!(ask(&unit_server, &rights, unit_id, EVENT_LOG).unwrap(), [0x8C, 1]);
    }
}

/// Unit 7 has files 4 and 3 and two queues, unit 8 only the files.
fn with_files(seal: Option<Gate>) -> (Arc<Memory>, PeerRights) {
    let span = |size| Span::new(0, size).unwrap();
    let layout = Layout::default()
        .with(Area::HoldingRegisters, span(1250))
        .with(Area::Coils, span(1))
        .with(Area::File(4), span(10_000))
        .with(Area::File(3), span(11));
    let memory = Arc::new(Memory::new(layout, seal).unwrap());
    let own = Narrowed {
        access: AccessMode::ReadWrite,
        functions: Functions::All,
        ranges: Ranges::default(),
        exception_status: None,
        queues: Box::new([1246, 100]),
    };
    let rights = with_own(&memory, own);
    (memory, rights)
}

fn with_own(memory: &Arc<Memory>, own: Narrowed) -> PeerRights {
    PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units: vec![(7, Arc::clone(memory)), (8, Arc::clone(memory))],
        destinations: Vec::new(),
        access: AccessMode::ReadWrite,
        functions: Functions::All,
        narrowed: vec![(7, own)],
    })
}

fn fill(memory: &Memory, area: Area, address: u16, values: &[u16]) {
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_be_bytes()).collect();
    let write = Write { area, address, count: values.len(), bytes: &bytes };
    memory.write(Access::Ingest, write).unwrap();
}

#[test]
fn functions_20_and_21_answer_as_the_examples_of_the_standard_do() {
    let ((memory, rights), unit_server) = (with_files(None), unit_server());
    fill(&memory, Area::File(4), 1, &[0x0DFE, 0x0020]);
    fill(&memory, Area::File(3), 9, &[0x33CD, 0x0040]);
    let read = [20, 0x0E, 6, 0, 4, 0, 1, 0, 2, 6, 0, 3, 0, 9, 0, 2];
    let answer = [20, 0x0C, 5, 6, 0x0D, 0xFE, 0x00, 0x20, 5, 6, 0x33, 0xCD, 0x00, 0x40];
    assert_eq!(ask(&unit_server, &rights, 7, &read).unwrap(), answer);
    let write = [21, 0x0D, 6, 0, 4, 0, 7, 0, 3, 0x06, 0xAF, 0x04, 0xBE, 0x10, 0x0D];
    assert_eq!(ask(&unit_server, &rights, 8, &write).unwrap(), write);
    let written = ask(&unit_server, &rights, 8, &[20, 7, 6, 0, 4, 0, 7, 0, 3]).unwrap();
    assert_eq!(written, [20, 8, 7, 6, 0x06, 0xAF, 0x04, 0xBE, 0x10, 0x0D]);
}

#[test]
fn files_are_refused_as_the_diagrams_of_the_standard_say() {
    let ((memory, rights), unit_server) = (with_files(None), unit_server());
    for (request, code) in [
        // The byte count.
        (&[20, 0][..], 3),
        (&[20, 6, 6, 0, 4, 0, 1, 0], 3),
        (&[20, 8, 6, 0, 4, 0, 1, 0, 2], 3),
        (&[20, 7, 6, 0, 4, 0, 1, 0, 2, 0], 3),
        (&[21, 7, 6, 0, 4, 0, 1, 0, 0], 3),
        (&[21, 9, 6, 0, 4, 0, 1, 0, 2, 1, 1], 3),
        // 122 records do not fit into a reply.
        (&[20, 7, 6, 0, 4, 0, 1, 0, 122], 3),
        // The reference type, the file and the record.
        (&[20, 7, 7, 0, 4, 0, 1, 0, 2], 2),
        (&[20, 7, 6, 0, 0, 0, 1, 0, 2], 2),
        (&[20, 7, 6, 0, 5, 0, 1, 0, 2], 2),
        (&[20, 7, 6, 0, 4, 0x27, 0x10, 0, 1], 2),
        (&[20, 7, 6, 0, 4, 0x27, 0x0F, 0, 2], 2),
        (&[20, 7, 6, 0, 3, 0, 10, 0, 2], 2),
        (&[20, 7, 6, 0, 4, 0, 1, 0, 0], 2),
        (&[21, 9, 5, 0, 4, 0, 1, 0, 1, 1, 1], 2),
        (&[21, 9, 6, 0, 3, 0, 11, 0, 1, 1, 1], 2),
    ] {
        let refused = [request[0] | 0x80, code];
        assert_eq!(ask(&unit_server, &rights, 7, request).unwrap(), refused, "{request:?}");
    }
    assert_eq!(memory.writes(), 0);
}

#[test]
fn several_records_are_written_together_or_not_at_all() {
    let ((memory, rights), unit_server) = (with_files(None), unit_server());
    let both = [21, 18, 6, 0, 4, 0, 7, 0, 1, 1, 1, 6, 0, 3, 0, 10, 0, 1, 2, 2];
    assert_eq!(ask(&unit_server, &rights, 7, &both).unwrap(), both);
    assert_eq!(memory.writes(), 1);
    let mut beyond = both;
    (beyond[9], beyond[15]) = (9, 11);
    assert_eq!(ask(&unit_server, &rights, 7, &beyond).unwrap(), [0x95, 2]);
    let read = [20, 14, 6, 0, 4, 0, 7, 0, 1, 6, 0, 3, 0, 10, 0, 1];
    assert_eq!(ask(&unit_server, &rights, 7, &read).unwrap(), [20, 8, 3, 6, 1, 1, 3, 6, 2, 2]);
    assert_eq!(memory.writes(), 1);
}

#[test]
fn a_unit_without_files_or_queues_does_not_have_their_functions() {
    let (plain, unit_server) = (memory(10), unit_server());
    let rights = rights(&[(7, &plain)], AccessMode::ReadWrite);
    for request in [&[20][..], &[20, 7, 6, 0, 4, 0, 1, 0, 2], &[21], &[24, 0, 0]] {
        assert_eq!(ask(&unit_server, &rights, 7, request).unwrap(), [request[0] | 0x80, 1]);
    }
    let (_, rights) = with_files(None);
    assert_eq!(ask(&unit_server, &rights, 8, &[24, 4, 0xDE]).unwrap(), [0x98, 1]);
    assert_eq!(ask(&unit_server, &rights, 9, &[20, 0]).unwrap(), [0x94, 0x0B]);
}

#[test]
fn function_24_answers_as_the_example_of_the_standard_does() {
    let ((memory, rights), unit_server) = (with_files(None), unit_server());
    fill(&memory, Area::HoldingRegisters, 1246, &[2, 0x01B8, 0x1284]);
    let read = [24, 4, 0xDE];
    let answer = [24, 0, 6, 0, 2, 0x01, 0xB8, 0x12, 0x84];
    for _ in 0..2 {
        assert_eq!(ask(&unit_server, &rights, 7, &read).unwrap(), answer, "it stays as it is");
    }
    let queue = [24, 0, 100];
    assert_eq!(ask(&unit_server, &rights, 7, &queue).unwrap(), [24, 0, 2, 0, 0]);
    fill(&memory, Area::HoldingRegisters, 100, &[31]);
    let full = ask(&unit_server, &rights, 7, &queue).unwrap();
    assert_eq!((&full[..5], full.len()), (&[24, 0, 64, 0, 31][..], 67));
    for count in [32, u16::MAX] {
        fill(&memory, Area::HoldingRegisters, 100, &[count]);
        assert_eq!(ask(&unit_server, &rights, 7, &queue).unwrap(), [0x98, 3]);
    }
    // 1250 does not exist.
    fill(&memory, Area::HoldingRegisters, 1246, &[4]);
    assert_eq!(ask(&unit_server, &rights, 7, &read).unwrap(), [0x98, 2]);
    assert_eq!(ask(&unit_server, &rights, 7, &[24, 4, 0xDF]).unwrap(), [0x98, 2], "not a queue");
    assert_eq!(ask(&unit_server, &rights, 7, &[24, 4]).unwrap(), [0x98, 3]);
}

#[test]
fn files_and_queues_have_the_checks_of_other_reads_and_writes() {
    let unit_server = unit_server();
    let write = &[21, 9, 6, 0, 4, 0, 7, 0, 1, 1, 1][..];
    let (read, queue) = (&[20, 7, 6, 0, 4, 0, 7, 0, 1][..], &[24, 0, 100][..]);
    let gate = Gate { area: Area::Coils, address: 0, mode: GateMode::Level };
    let (_, rights) = with_files(Some(gate));
    for request in [read, write, queue] {
        assert_eq!(ask(&unit_server, &rights, 7, request).unwrap(), [request[0] | 0x80, 6]);
    }
    let (memory, _) = with_files(None);
    let items = |area, address, count| vec![Items { area, address, count }];
    let own = |access, functions, read, write| {
        let (queues, ranges) = (Box::new([100]), Ranges::new(read, write));
        let own = Narrowed { access, functions, ranges, exception_status: None, queues };
        with_own(&memory, own)
    };
    let registers = |address, count| items(Area::HoldingRegisters, address, count);
    let file = |address, count| items(Area::File(4), address, count);
    let (only_reads, writes) = (AccessMode::ReadOnly, AccessMode::ReadWrite);
    let denied = Functions::Except(vec![20, 24]);
    let all = Functions::All;
    for (rights, codes) in [
        (own(only_reads, all.clone(), None, None), [0, 1, 0]),
        (own(writes, denied, None, None), [1, 0, 1]),
        (own(writes, all.clone(), Some(registers(100, 32)), Some(registers(0, 9))), [2, 2, 0]),
        (own(writes, all.clone(), Some(registers(100, 31)), None), [2, 0, 2]),
        (own(writes, all.clone(), Some(file(7, 1)), Some(file(6, 2))), [0, 0, 2]),
        (own(writes, all, Some(file(8, 9)), Some(file(0, 7))), [2, 2, 2]),
    ] {
        for (request, code) in [read, write, queue].into_iter().zip(codes) {
            let reply = ask(&unit_server, &rights, 7, request).unwrap();
            let refused = [request[0] | 0x80, code];
            assert!(if code == 0 { reply[0] == request[0] } else { reply == refused }, "{reply:?}");
        }
    }
}
