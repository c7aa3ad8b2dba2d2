//! Seals that open once, of memories that nodes share: what a restart closes.

mod nodes;

use std::sync::Arc;
use std::time::Duration;

use holdfast_journal::log::{LogReader, Phase, Settings, Until};
use holdfast_memory::{Access, Action, Gate, GateMode, Layout, Memory, Refusal, Span, Write};
use nodes::{DEADLINE, GATE, Node, Server, memory_of, until};

const BIT: u16 = 63;

fn sealed(mode: GateMode) -> Arc<Memory> {
    let layout: Layout = memory_of(100).layout().clone().with(GATE, Span::new(0, 64).unwrap());
    Arc::new(Memory::new(layout, Some(Gate { area: GATE, address: BIT, mode })).unwrap())
}

fn opened_by(memory: &Memory) {
    let write = Write { area: GATE, address: BIT, count: 1, bytes: &[1] };
    memory.write(Access::Ingest, write).unwrap();
}

fn gate_bit(node: &Node) -> u8 {
    Memory::contents(std::slice::from_ref(&node.memory))[0].areas[0][7] >> 7
}

fn node(server: &Server, name: &str, answer_timeout: Duration) -> Node {
    let change = |settings: &mut Settings| settings.answer_timeout = answer_timeout;
    Node::with(sealed(GateMode::Once), &[server], name, change)
}

fn started(server: &Server, name: &str) -> Node {
    let node = node(server, name, Duration::from_millis(50));
    node.start();
    node
}

#[test]
fn the_only_node_is_sealed_again_when_it_starts() {
    let server = Server::new();
    let a = started(&server, "a");
    assert_eq!(a.read(0), Err(Refusal::Sealed));
    opened_by(&a.memory);
    a.write(0, 7).unwrap();
    for _ in 0..2 {
        a.log.stop();
        // Another node can't answer, as there was none: it does not wait for one.
        let a = node(&server, "a", DEADLINE * 10);
        a.start();
        assert_eq!((a.read(0), gate_bit(&a)), (Err(Refusal::Sealed), 0));
        opened_by(&a.memory);
        assert_eq!(a.read(0), Ok(7));
        a.log.stop();
    }
}

#[test]
fn a_node_that_starts_while_another_one_runs_is_open_as_that_one_is() {
    let server = Server::new();
    let [a, b] = ["a", "b"].map(|name| started(&server, name));
    opened_by(&a.memory);
    a.write(0, 7).unwrap();
    until("the other node is open", || b.read(0) == Ok(7));
    a.log.stop();
    let a = node(&server, "a", DEADLINE * 10);
    a.start();
    b.log.stop();
    let b = node(&server, "b", DEADLINE * 10);
    b.start();
    for node in [&a, &b] {
        assert_eq!((node.read(0), gate_bit(node)), (Ok(7), 1));
    }
}

#[test]
fn nodes_that_all_start_are_sealed_again_and_stay_open_once_they_were_opened() {
    let server = Server::new();
    let names = ["a", "b", "c"];
    let before = names.map(|name| started(&server, name));
    opened_by(&before[0].memory);
    before.iter().for_each(|node| node.log.stop());
    let nodes = names.map(|name| node(&server, name, Duration::from_millis(50)));
    std::thread::scope(|scope| {
        nodes.iter().for_each(|node| drop(scope.spawn(|| node.start())));
    });
    for node in &nodes {
        assert_eq!((node.read(0), gate_bit(node)), (Err(Refusal::Sealed), 0));
    }
    opened_by(&nodes[1].memory);
    until("the seal is open", || !nodes[2].memory.sealed());
    nodes[2].write(0, 7).unwrap();
    let last = nodes[2].status().sequence;
    for node in &nodes {
        node.until_applied(last);
        assert_eq!(node.read(0), Ok(7));
    }
    assert!(nodes[1..].iter().all(|node| node.all() == nodes[0].all()));
}

#[test]
fn a_node_that_gave_no_answer_is_sealed_again_with_the_one_that_has_started() {
    let server = Server::new();
    let [a, b] = ["a", "b"].map(|name| started(&server, name));
    opened_by(&a.memory);
    a.log.stop();
    // It does not know yet itself whether seals stay open, so it can't answer.
    b.log.stop();
    let waiting = node(&server, "b", DEADLINE * 10);
    waiting.log.start().unwrap();
    until("the other node asks", || waiting.log.awaits_seal_answer());
    let error = waiting.log.startup_timeout_error(DEADLINE).to_string();
    assert!(error.contains("no other node has said"), "{error}");
    let a = started(&server, "a");
    assert_eq!(a.read(0), Err(Refusal::Sealed));
    assert!(waiting.log.wait_until_caught_up(DEADLINE).unwrap());
    assert!(!waiting.log.awaits_seal_answer());
    assert_eq!(waiting.read(0), Err(Refusal::Sealed));
}

#[test]
fn a_node_with_the_shortest_lag_closes_seals_too() {
    let server = Server::new();
    let start = |name| {
        let node = Node::with(sealed(GateMode::Once), &[&server], name, |settings| {
            settings.answer_timeout = Duration::from_millis(50);
            settings.max_lag = Duration::from_millis(50);
        });
        node.start();
        node
    };
    let [a, b] = ["a", "b"].map(start);
    opened_by(&a.memory);
    a.log.stop();
    b.log.stop();
    assert_eq!(start("a").read(0), Err(Refusal::Sealed));
}

#[test]
fn a_node_whose_contents_were_wrong_while_it_asked_serves_when_it_knows() {
    const COMPARED: u64 = 100;
    let server = Server::new();
    let names = ["a", "b", "c"];
    let node = |name| {
        Node::with(sealed(GateMode::Once), &[&server], name, |settings| {
            settings.answer_timeout = DEADLINE * 10;
            settings.digest_steps = COMPARED;
        })
    };
    let before = names.map(node);
    before.iter().for_each(Node::start);
    opened_by(&before[0].memory);
    while before[0].status().sequence < COMPARED - 10 {
        before[0].write(0, 7).unwrap();
    }
    before.iter().for_each(|node| node.log.stop());
    let nodes = names.map(node);
    nodes.iter().for_each(|node| node.log.start().unwrap());
    let wrong = &nodes[2];
    until("all ask", || nodes.iter().all(|node| node.log.awaits_seal_answer()));
    let mut contents = Memory::contents(std::slice::from_ref(&wrong.memory)).remove(0);
    contents.areas[2][1] ^= 1;
    wrong.memory.restore(&contents);
    let is_returning = || matches!(wrong.status().phase, Phase::Returning(_));
    until("its contents are found wrong", is_returning);
    until("it asks again", || wrong.log.awaits_seal_answer());
    // It waits no longer, and closes the seals.
    started(&server, "d");
    until("its contents are right", || !is_returning());
    assert_eq!(wrong.status().phase, Phase::Running);
    assert!(wrong.status().sequence < 2 * COMPARED, "not only at the next comparison");
    opened_by(&wrong.memory);
    assert_eq!(wrong.read(0), Ok(7));
}

#[test]
fn what_a_log_begins_with_stays_open_until_a_restart() {
    let server = Server::new();
    let memory = sealed(GateMode::Once);
    opened_by(&memory);
    let a = Node::with(memory, &[&server], "a", |_| {});
    a.start();
    let b = started(&server, "b");
    assert_eq!((a.read(0), b.read(0)), (Ok(0), Ok(0)));
    a.log.stop();
    b.log.stop();
    assert_eq!(started(&server, "b").read(0), Err(Refusal::Sealed));
}

#[test]
fn a_seal_that_follows_its_gate_bit_stays_as_the_bit_is() {
    let server = Server::new();
    for _ in 0..2 {
        let node = Node::with(sealed(GateMode::Level), &[&server], "a", |_| {});
        node.start();
        if gate_bit(&node) == 0 {
            opened_by(&node.memory);
        }
        assert_eq!(node.read(0), Ok(0));
        node.log.stop();
    }
}

#[test]
fn a_replay_seals_where_the_nodes_did() {
    let server = Server::new();
    let a = started(&server, "a");
    opened_by(&a.memory);
    a.log.stop();
    let a = started(&server, "a");
    let settings = Settings::new("site", "replay", vec![server.url()]);
    let memory = sealed(GateMode::Once);
    let members = vec![("plant".to_owned(), Arc::clone(&memory))];
    let mut reader = LogReader::open(&settings, members, Until::Now, DEADLINE).unwrap();
    let mut bits = Vec::new();
    while let Some(record) = reader.next(DEADLINE).unwrap() {
        for step in record.steps {
            let Action::Write(writes) = step.action else { panic!("only writes") };
            bits.extend(writes.into_iter().map(|write| (write.area, write.address, write.bytes)));
        }
    }
    assert_eq!(bits, [(GATE, BIT, vec![1]), (GATE, BIT, vec![0])]);
    assert!(memory.sealed() && a.memory.sealed());
    let of = |memory| Memory::contents(std::slice::from_ref(memory));
    assert_eq!(of(&memory), of(&a.memory));
}
