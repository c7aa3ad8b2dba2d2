//! Nodes that share a log over a real nats-server.

mod nodes;

use std::collections::HashSet;
use std::io::{BufRead, BufReader, Write as _};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use async_nats::jetstream::stream::Info;
use futures_util::{StreamExt, TryStreamExt};
use holdfast_journal::log::{LogError, LogReader, Phase, Record, Settings, Until};
use holdfast_memory::{
    Access, Action, Area, Freshness, Memory, Mirrored, Operation, Outcome, Read, Refusal, Refused,
    Span, Step, StepWrite, Tenure, Term, Write, write_across,
};
use nodes::process::{Answer, Process};
use nodes::{Folder, Node, REGISTERS, Server, cluster, free_port, introduced, memory_of, until};

fn step(address: u16, value: u16) -> Step {
    let write = StepWrite {
        member: 0,
        area: REGISTERS,
        address,
        count: 1,
        bytes: value.to_be_bytes().to_vec(),
    };
    Step { access: Access::Ingest, tenure: None, action: Action::Write(vec![write]) }
}

#[test]
fn two_nodes_agree_on_a_register() {
    let server = Server::new();
    let (a, b) = (Node::started(&[&server], "a"), Node::started(&[&server], "b"));
    a.write(3, 7).unwrap();
    assert_eq!(a.read(3), Ok(7), "a node reads its own writes");
    until("the other node has it", || b.read(3) == Ok(7));
    b.write(3, 8).unwrap();
    assert_eq!(b.read(3), Ok(8));
    until("the first node has it", || a.read(3) == Ok(8));
}

#[test]
fn files_are_shared_as_areas_are() {
    let server = Server::new();
    let memory = |records| {
        let layout = memory_of(1).layout().clone();
        let layout = layout.with(Area::File(4), Span::new(0, records).unwrap());
        Arc::new(Memory::new(layout, None).unwrap())
    };
    let [a, b] = ["a", "b"].map(|name| Node::with(memory(600), &[&server], name, |_| {}));
    a.start();
    let bytes = [7; 4];
    let records = |address| Write { area: Area::File(4), address, count: 2, bytes: &bytes };
    a.memory.write_many(Access::Client, &[records(0), records(598)]).unwrap();
    let refused = Refused { index: 1, refusal: Refusal::OutOfRange };
    assert_eq!(a.memory.write_many(Access::Client, &[records(5), records(599)]), Err(refused));
    // It has the records from a snapshot, or from the steps.
    b.start();
    b.until_applied(a.status().last_sequence);
    assert_eq!(a.all(), b.all());
    assert_eq!(b.all()[b.all().len() - 1200..][..4], [7; 4]);
    assert_eq!(a.status().steps, 1, "what is refused is no step");
    let other = Node::with(memory(601), &[&server], "c", |_| {});
    let error = other.try_start().unwrap_err().to_string();
    assert!(error.contains("file:4 0+600 in the log"), "{error}");
}

#[test]
fn writes_that_meet_lead_to_the_same_everywhere() {
    let server = Server::new();
    let nodes = ["a", "b", "c"].map(|name| Node::started(&[&server], name));
    std::thread::scope(|scope| {
        for (index, node) in nodes.iter().enumerate() {
            scope.spawn(move || {
                for round in 0..100_u16 {
                    let bit = 1 << (3 * (round % 5) + index as u16);
                    // Sets a bit, or clears it.
                    let or = if round % 2 == 0 { bit } else { 0 };
                    node.memory.mask_write(Access::Client, REGISTERS, 0, !bit, or).unwrap();
                    node.write(1, round * 3 + index as u16).unwrap();
                    let (bytes, mut out) = ([1, round as u8], [0; 2]);
                    let write = Write { area: REGISTERS, address: 2, count: 1, bytes: &bytes };
                    let read = Read { area: REGISTERS, address: 1, count: 1, out: &mut out };
                    node.memory.write_then_read(Access::Client, write, read).unwrap();
                }
            });
        }
    });
    let last = nodes.iter().map(|node| node.status().last_sequence).max().unwrap();
    for node in &nodes {
        node.until_applied(last);
        assert_eq!(node.all(), nodes[0].all());
        assert_eq!(node.status().steps, 300);
        assert_eq!(node.status().refused, 0);
    }
}

#[test]
fn a_write_then_read_returns_what_was_there_at_its_place_in_the_order() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    node.write(1, 500).unwrap();
    let mut out = [0; 4];
    let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &[0, 9] };
    let read = Read { area: REGISTERS, address: 0, count: 2, out: &mut out };
    node.memory.write_then_read(Access::Client, write, read).unwrap();
    assert_eq!(out, [0, 9, 1, 244]);
}

#[test]
fn writes_given_away_together_are_carried_out_in_their_order() {
    let server = Server::new();
    let (a, b) = (Node::started(&[&server], "a"), Node::started(&[&server], "b"));
    let (sender, receiver) = std::sync::mpsc::channel();
    for value in 0..2000_u16 {
        let bytes = value.to_be_bytes();
        let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &bytes };
        let sender = sender.clone();
        let done = Box::new(move |outcome| sender.send((value, outcome)).unwrap());
        a.memory.submit(Access::Client, Operation::Write(&[write]), done).unwrap();
    }
    let mut before = 0;
    for value in 0..2000 {
        let (of, outcome) = receiver.recv().unwrap();
        assert_eq!(of, value);
        let sequence = outcome.unwrap().sequence.expect("a log has the step");
        assert!(before <= sequence, "steps that travel together share a message");
        before = sequence;
    }
    assert_eq!(a.read(0), Ok(1999));
    until("the other node has the last", || b.read(0) == Ok(1999));
    let messages = a.status().last_sequence;
    assert!(messages < 1500, "small steps travel together: {messages} messages");
}

#[test]
fn a_step_across_memories_is_one_step() {
    let server = Server::new();
    let node = |name: &str| {
        let memories = [memory_of(10), memory_of(20)];
        let named = memories.iter().zip(["x", "y"]);
        let named = named.map(|(memory, name)| (name.to_owned(), Arc::clone(memory))).collect();
        let settings = holdfast_journal::log::Settings::new("site", name, vec![server.url()]);
        let log = holdfast_journal::log::Log::new(settings, named).unwrap();
        log.start().unwrap();
        assert!(log.wait_until_caught_up(nodes::DEADLINE).unwrap());
        (log, memories)
    };
    let ((_a, of_a), (_b, of_b)) = (node("a"), node("b"));
    let stop = AtomicBool::new(false);
    let both = |memories: &[Arc<Memory>; 2]| {
        let contents = Memory::contents(memories);
        [contents[0].areas[2][0], contents[1].areas[2][0]]
    };
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for value in 0..100 {
                let bytes = [value, 0];
                let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &bytes };
                let writes = [(&*of_a[0], write), (&*of_a[1], write)];
                write_across(Access::Ingest, &writes).unwrap();
            }
            stop.store(true, Ordering::Release);
        });
        while !stop.load(Ordering::Acquire) {
            let [x, y] = both(&of_b);
            assert_eq!(x, y, "half a step is seen");
        }
    });
    let other = memory_of(5);
    let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &[1, 1] };
    let refused = write_across(Access::Ingest, &[(&*of_a[0], write), (&*other, write)]);
    assert_eq!(refused.unwrap_err().refusal, Refusal::NotOneStep);
}

#[test]
fn the_first_node_decides_what_a_log_begins_with() {
    let server = Server::new();
    let with = |value: u8, name: &str| {
        let memory = nodes::memory();
        let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &[0, value] };
        memory.write(Access::Ingest, write).unwrap();
        Node::with(memory, &[&server], name, |_| {})
    };
    let (a, b) = (with(5, "a"), with(6, "b"));
    a.start();
    b.start();
    assert_eq!((a.read(0), b.read(0)), (Ok(5), Ok(5)));
}

#[test]
fn nodes_that_start_at_once_begin_with_the_same() {
    let server = Server::new();
    let nodes: Vec<Node> = (1..=5_u8)
        .map(|value| {
            let memory = nodes::memory();
            let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &[0, value] };
            memory.write(Access::Ingest, write).unwrap();
            Node::with(memory, &[&server], &format!("n{value}"), |_| {})
        })
        .collect();
    std::thread::scope(|scope| {
        for node in &nodes {
            scope.spawn(|| node.start());
        }
    });
    let first = nodes[0].read(0).unwrap();
    assert!((1..=5).contains(&first));
    for node in &nodes {
        assert_eq!(node.read(0), Ok(first));
    }
}

#[test]
fn another_layout_is_refused_and_named() {
    let server = Server::new();
    let _a = Node::started(&[&server], "a");
    let b = Node::with(memory_of(101), &[&server], "b", |_| {});
    let error = b.try_start().unwrap_err();
    assert_eq!(error.kind(), "layout");
    let expected = "the layout differs from that of the log: memory \"plant\" is coils 0+64, \
                    holding_registers 0+100 in the log, here it is coils 0+64, holding_registers \
                    0+101: correct it, or begin a log with another name";
    assert_eq!(error.to_string(), expected);
}

#[test]
fn nodes_with_different_layouts_that_start_at_once_do_not_share_a_log() {
    let server = Server::new();
    let nodes: Vec<Node> = (0..6)
        .map(|index| {
            let memory = memory_of(100 + index % 2);
            Node::with(memory, &[&server], &format!("n{index}"), |_| {})
        })
        .collect();
    let started: Vec<bool> = std::thread::scope(|scope| {
        let starts: Vec<_> =
            nodes.iter().map(|node| scope.spawn(|| node.try_start().is_ok())).collect();
        starts.into_iter().map(|start| start.join().unwrap()).collect()
    });
    let expected = started[0];
    for (index, started) in started.into_iter().enumerate() {
        assert_eq!(started == expected, index % 2 == 0, "node {index}");
    }
}

#[test]
fn without_a_server_nothing_starts_and_the_error_says_why() {
    let mut server = Server::new();
    server.kill();
    let node = Node::new(&[&server], "a", |_| {});
    node.log.start().unwrap();
    assert!(!node.log.wait_until_caught_up(Duration::from_millis(300)).unwrap());
    let error = node.log.startup_timeout_error(Duration::from_millis(300));
    assert_eq!(error.kind(), "no_connection");
    assert!(error.to_string().contains("connect"), "{error}");
    assert_eq!(node.write(0, 1), Err(Refusal::Unavailable));
}

#[test]
fn without_a_server_it_stops_soon() {
    let mut server = Server::new();
    server.kill();
    for _ in 0..20 {
        let node = Node::new(&[&server], "a", |_| {});
        node.log.start().unwrap();
        until("it has tried", || node.status().last_error.is_some());
        let (sender, stopped) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            node.log.stop();
            sender.send(()).unwrap();
        });
        stopped.recv_timeout(nodes::DEADLINE).expect("it stops");
    }
}

#[test]
fn a_killed_server_refuses_writes_at_once_and_comes_back() {
    let mut server = Server::new();
    let (a, b) = (Node::started(&[&server], "a"), Node::started(&[&server], "b"));
    a.write(0, 1).unwrap();
    server.kill();
    until("the node sees it", || a.write(0, 2) == Err(Refusal::Unavailable));
    assert_eq!(a.read(0), Ok(1), "reads go on");
    assert!(a.status().unavailable > 0);
    until("the status says so", || a.status().server.is_none());
    server.start();
    a.write_at_last(1, 3);
    until("the other node has it", || b.read(1) == Ok(3));
    b.write_at_last(2, 4);
    until("the first node has it", || a.read(2) == Ok(4));
    assert_eq!(a.read(0), b.read(0));
}

#[test]
fn a_server_that_does_not_answer_leaves_writes_unconfirmed() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", |settings| {
        settings.write_timeout = Duration::from_secs(1);
    });
    node.start();
    server.signal("STOP");
    assert_eq!(node.write(0, 1), Err(Refusal::NotConfirmed));
    assert_eq!(node.status().not_confirmed, 1);
    // After a while it counts as lost.
    until("writes are refused at once", || node.write(0, 2) == Err(Refusal::Unavailable));
    server.signal("CONT");
    node.write_at_last(1, 5);
    assert_eq!(node.read(1), Ok(5));
}

#[test]
fn a_message_that_is_sent_twice_is_applied_once() {
    let server = Server::new();
    let (a, b) = (Node::started(&[&server], "a"), Node::started(&[&server], "b"));
    a.write(0, 1).unwrap();
    // Each message of the stream again, without the header by which the server finds duplicates.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let mask = |node: &Node| node.memory.mask_write(Access::Client, REGISTERS, 5, 0, 0xFFFF);
    mask(&a).unwrap();
    a.write(5, 3).unwrap();
    let before = a.all();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let stream = jetstream.get_stream("holdfast-log-site").await.unwrap();
        let last = stream.cached_info().state.last_sequence;
        for sequence in 1..=last {
            let message = stream.get_raw_message(sequence).await.unwrap();
            let publish = jetstream.publish("holdfast.log.site.steps", message.payload);
            publish.await.unwrap().await.unwrap();
        }
        let publish = jetstream.publish("holdfast.log.site.steps", "not of a node".into());
        let last = publish.await.unwrap().await.unwrap().sequence;
        a.until_applied(last);
        b.until_applied(last);
    });
    assert_eq!((a.all(), b.all()), (before.clone(), before));
    assert!(a.status().stale > 2, "{:?}", a.status());
    assert_eq!(a.status().ignored, 1);
    a.write(6, 1).unwrap();
}

/// Publishes with headers as they are, and waits until the server has them.
fn publish_raw(server: &Server, subject: &[u8], headers: &[u8], payload: &[u8]) {
    let mut socket = std::net::TcpStream::connect(("127.0.0.1", server.port)).unwrap();
    let lengths = format!(" {} {}\r\n", headers.len(), headers.len() + payload.len());
    let connect = b"CONNECT {\"headers\":true,\"verbose\":false,\"pedantic\":false}\r\nHPUB ";
    let parts = [connect, subject, lengths.as_bytes(), headers, payload, b"\r\nPING\r\n"];
    socket.write_all(&parts.concat()).unwrap();
    let mut answers = BufReader::new(socket).lines().map(Result::unwrap);
    let answer = answers.find(|line| !line.starts_with("INFO"));
    assert_eq!(answer.as_deref(), Some("PONG"));
}

const STEPS: &[u8] = b"holdfast.log.site.steps";

/// Headers that the client library can't parse, or takes for an answer of the server.
const HEADERS: [&[u8]; 9] = [
    b"NATS/9.9\r\n\r\n",
    b"\xFF\xFE\r\n\r\n",
    b"NATS/1.0\r\n\xFF: \xFF\r\n\r\n",
    b"NATS/1.0\r\nwithout a colon\r\n\r\n",
    b"NATS/1.0 abc\r\n\r\n",
    b"NATS/1.0 100\r\n\r\n",
    b"NATS/1.0 408 Request Timeout\r\nNats-Pending-Messages: x\r\n\r\n",
    b"NATS/1.0 409 Consumer Deleted\r\n\r\n",
    b"NATS/1.0 503\r\n\r\n",
];

#[test]
fn messages_with_headers_that_nobody_can_read_are_ignored() {
    let server = Server::new();
    let (a, b) = (Node::started(&[&server], "a"), Node::started(&[&server], "b"));
    a.write(0, 1).unwrap();
    for (count, headers) in HEADERS.iter().enumerate() {
        publish_raw(&server, STEPS, headers, b"payload");
        a.write_at_last(1, count as u16);
        until("both have ignored it", || {
            [&a, &b].iter().all(|node| node.status().ignored == count as u64 + 1)
        });
    }
    let events = a.log.take_events(Duration::ZERO);
    let count = |name: &str| events.iter().filter(|event| event.name == name).count();
    assert_eq!(count("log_message_ignored"), HEADERS.len());
    assert!(count("log_disconnected") < HEADERS.len(), "after the first one, messages are fetched");
    // Later a consumer delivers messages again, and does not survive one of these.
    (0..120).for_each(|_| a.write_at_last(1, HEADERS.len() as u16 - 1));
    until("a consumer delivers messages", || {
        publish_raw(&server, STEPS, HEADERS[0], b"payload");
        a.write_at_last(4, 4);
        a.log.take_events(Duration::ZERO).iter().any(|event| event.name == "log_disconnected")
    });
    until("the other node has the last write", || b.read(1) == Ok(HEADERS.len() as u16 - 1));
    // Also after a restart, and if there are many, and if the last one is one of them.
    drop(a);
    for _ in 0..20 {
        for headers in HEADERS {
            publish_raw(&server, STEPS, headers, b"payload");
        }
        b.write_at_last(2, 5);
    }
    publish_raw(&server, STEPS, HEADERS[0], &vec![b'x'; 1_000_000]);
    for name in ["a", "c"] {
        let node = Node::started(&[&server], name);
        assert_eq!(node.read(2), Ok(5));
        assert!(node.status().ignored > 21 * HEADERS.len() as u64);
        node.write(3, 3).unwrap();
    }
    until("a node that was there has it", || b.read(3) == Ok(3));
}

/// Servers with a JetStream of their own that are joined by a leaf node give each other what is published.
#[test]
fn messages_of_another_log_with_this_name_are_ignored() {
    let (server, others) = (Server::new(), Server::new());
    let (a, other) = (Node::started(&[&server], "a"), Node::started(&[&others], "other"));
    other.write(0, 42).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let message = runtime.block_on(async {
        let client = async_nats::connect(others.url()).await.unwrap();
        let stream = async_nats::jetstream::new(client).get_stream("holdfast-log-site").await;
        let stream = stream.unwrap();
        stream.get_raw_message(other.status().last_sequence).await.unwrap()
    });
    let id = message.headers.get("Holdfast-Log-Id").unwrap();
    let headers = format!("NATS/1.0\r\nHoldfast-Log-Id: {id}\r\n\r\n");
    publish_raw(&server, STEPS, headers.as_bytes(), &message.payload);
    until("it is ignored", || a.status().ignored == 1);
    let events = a.log.take_events(Duration::ZERO);
    let ignored = events.iter().find(|event| event.name == "log_message_ignored").unwrap();
    assert!(ignored.fields[1].1.starts_with("it is of another log with this name"), "{ignored:?}");
    a.write(1, 1).unwrap();
    let settings = Settings::new("site", "replay", vec![server.url()]);
    let members = vec![("plant".to_owned(), memory_of(100))];
    let mut reader = LogReader::open(&settings, members, Until::Now, nodes::DEADLINE).unwrap();
    let records: Vec<_> = std::iter::from_fn(|| reader.next(nodes::DEADLINE).unwrap()).collect();
    let steps = |record: &Record| (record.sequence.to_string(), record.steps.len());
    assert!(records.iter().map(steps).any(|found| found == (ignored.fields[0].1.clone(), 0)));
    assert_eq!(a.read(0), Ok(0));
    // Older releases send no such header.
    publish_raw(&server, STEPS, b"NATS/1.0\r\n\r\n", &message.payload);
    until("it is applied", || a.status().nodes.contains_key("other"));
}

#[test]
fn keys_that_nobody_can_read_are_replaced() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", often);
    node.start();
    for (key, value) in [("digest.b", "x"), ("digest.\u{a0}", "x"), ("snapshot", "not JSON")] {
        let subject = format!("$KV.holdfast-log-site.{key}");
        publish_raw(&server, subject.as_bytes(), HEADERS[0], value.as_bytes());
        until("the keys are replaced", || {
            node.log.take_events(Duration::ZERO).iter().any(|event| {
                event.name == "log_error" && event.fields[0].1.starts_with("keys of the log")
            })
        });
        node.write_at_last(0, 7);
    }
    let other = Node::started(&[&server], "b");
    assert_eq!(other.read(0), Ok(7));
}

#[test]
fn a_replay_goes_on_behind_headers_that_nobody_can_read() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    for (value, headers) in HEADERS.iter().enumerate() {
        node.write_at_last(0, value as u16);
        publish_raw(&server, STEPS, headers, b"payload");
    }
    node.write_at_last(0, 500);
    let memory = memory_of(100);
    let members = vec![("plant".to_owned(), Arc::clone(&memory))];
    let settings = Settings::new("site", "replay", vec![server.url()]);
    let mut reader = LogReader::open(&settings, members, Until::Now, nodes::DEADLINE).unwrap();
    let mut foreign = 0;
    while let Some(record) = reader.next(nodes::DEADLINE).unwrap() {
        foreign += usize::from(record.origin.is_none());
    }
    assert!(reader.has_ended());
    assert_eq!(foreign, HEADERS.len());
    assert_eq!(Memory::contents(&[memory])[0].areas[2][..2], 500_u16.to_be_bytes());
}

#[test]
fn a_node_joins_late_with_a_snapshot_and_the_stream_is_purged() {
    let server = Server::new();
    let soon = |settings: &mut holdfast_journal::log::Settings| settings.snapshot_steps = 20;
    let a = Node::new(&[&server], "a", soon);
    let b = Node::new(&[&server], "b", soon);
    a.start();
    b.start();
    let mut round = 0;
    until("two snapshots are taken", || {
        round += 1;
        a.write(round % 50, round).unwrap();
        b.write(50 + round % 50, round).unwrap();
        let events = a.log.take_events(Duration::ZERO);
        assert!(events.iter().all(|event| event.name != "log_snapshot_failed"), "{events:?}");
        first_sequence(&server) > 1 && a.status().snapshot.is_some_and(|sequence| sequence > 60)
    });
    let c = Node::started(&[&server], "c");
    let last = a.status().last_sequence.max(b.status().last_sequence);
    c.until_applied(last);
    a.until_applied(last);
    assert_eq!(c.all(), a.all());
    c.write(7, 7777).unwrap();
    until("all have it", || a.read(7) == Ok(7777) && b.read(7) == Ok(7777));
}

/// A log of few large messages would fill the disks of its servers.
#[test]
fn a_snapshot_is_also_due_by_bytes() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", |settings| settings.snapshot_bytes = 5000);
    node.start();
    assert!(node.status().snapshot.is_some(), "the one with which the log begins");
    let _peer = Node::started(&[&server], "peer");
    until("two snapshots are taken", || {
        node.write(0, 1).unwrap();
        first_sequence(&server) > 1
    });
}

/// What a node leaves whose connection is lost, or which is killed, while it stores a snapshot.
#[test]
fn parts_of_a_snapshot_that_was_cut_short_are_removed() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", |settings| settings.snapshot_steps = 20);
    node.start();
    // With another node, a snapshot is stored as soon as both have the same digest.
    let _peer = Node::started(&[&server], "peer");
    let left = "$O.holdfast-log-site.C.left";
    // Whoever sends this one may not remove the others.
    for subject in [left, "$O.holdfast-log-site.C.*"] {
        publish_raw(&server, subject.as_bytes(), b"NATS/1.0\r\n\r\n", b"part");
    }
    until("they are stored", || object_subjects(&server).contains(left));
    until("they are removed", || {
        node.write(0, 1).unwrap();
        !object_subjects(&server).contains(left)
    });
    let snapshot = node.status().snapshot;
    until("another snapshot is stored", || {
        node.write(0, 1).unwrap();
        node.status().snapshot > snapshot
    });
    let stored = object_subjects(&server);
    assert_eq!(
        stored.len(),
        5,
        "the parts and names of two snapshots, and what is not theirs: {stored:?}"
    );
    let other = Node::started(&[&server], "b");
    assert_eq!(other.read(0), Ok(1));
}

#[test]
fn snapshots_for_which_there_is_no_room_leave_nothing() {
    let server = Server::new();
    // A snapshot has several parts.
    let often = |settings: &mut Settings| settings.snapshot_steps = 20;
    let node = Node::with(memory_of(65_536), &[&server], "a", often);
    node.start();
    let peer = Node::with(memory_of(65_536), &[&server], "peer", often);
    peer.start();
    until("a snapshot is stored", || {
        node.write(0, 1).unwrap();
        node.status().snapshot.is_some_and(|sequence| sequence > 1)
    });
    let before = object_subjects(&server);
    change_stream(&server, "OBJ_holdfast-log-site", |info| {
        info.config.max_messages = info.state.messages as i64 + 1;
    });
    until("the next one fails", || {
        node.write(0, 1).unwrap();
        let events = node.log.take_events(Duration::ZERO);
        events.iter().any(|event| event.name == "log_snapshot_failed")
    });
    assert_eq!(object_subjects(&server), before);
}

#[test]
fn parts_of_a_snapshot_are_as_small_as_the_servers_accept() {
    let folder = Folder::new();
    let server = server_that_accepts(&folder, 65_536);
    let node = Node::with(memory_of(65_536), &[&server], "a", |_| ());
    node.start();
    node.write(0, 1).unwrap();
}

fn server_that_accepts(folder: &Folder, max_payload: usize) -> Server {
    let config = folder.0.join("config");
    std::fs::write(&config, format!("max_payload: {max_payload}")).unwrap();
    Server::with(free_port(), &["-c".to_owned(), config.to_str().unwrap().to_owned()])
}

/// A node with these registers. The server accepts messages of 8192 bytes, as for an account with this limit, and
/// says first that it accepts more, which is all that the client takes notice of.
fn limited(folder: &Folder, registers: u32) -> (Server, Node) {
    let server = server_that_accepts(folder, 8192);
    let url = introduced(&server, "max_payload", &serde_json::json!(1 << 20));
    let node = Node::with(memory_of(registers), &[], "a", |settings| {
        settings.servers.urls = vec![url];
    });
    node.start();
    (server, node)
}

/// Whether a session has ended for a message that was too large, which has lowered the limit to 8192 bytes.
fn has_lowered_limit(node: &Node) -> bool {
    node.log.take_events(Duration::ZERO).iter().any(|event| {
        event.fields.iter().any(|(key, reason)| {
            *key == "reason"
                && reason.starts_with("the server reports: Maximum Payload Violation: ")
                && reason.ends_with("at most 8192 bytes in a message")
        })
    })
}

#[test]
fn parts_of_a_snapshot_and_writes_fit_the_limit_of_an_account() {
    let folder = Folder::new();
    let (server, node) = limited(&folder, 65_536);
    assert!(has_lowered_limit(&node));
    let bytes = [7; 10_000];
    let write = |count: usize| {
        let bytes = &bytes[..count * 2];
        node.memory.write(Access::Client, Write { area: REGISTERS, address: 0, count, bytes })
    };
    assert_eq!(write(3000), Ok(()));
    let most = 8192 - 1152;
    assert!(matches!(write(5000), Err(Refusal::TooLarge { most: at, .. }) if at == most));
    drop(node);
    let b = Node::with(memory_of(65_536), &[&server], "b", |_| {});
    b.start();
    assert_eq!((b.read(2999), b.read(3000)), (Ok(0x0707), Ok(0)));
}

#[test]
fn steps_of_a_message_beyond_the_limit_of_an_account_are_carried_out_or_refused() {
    const STEPS: u16 = 128;
    let folder = Folder::new();
    let (_server, node) = limited(&folder, 1128);
    let (sender, receiver) = std::sync::mpsc::channel();
    // More than the messages that may be in flight have bytes.
    let round = |number: u16| -> usize {
        for step in 0..STEPS {
            let (large, marker) = ([0; 2000], number.to_be_bytes());
            let writes = [
                Write { area: REGISTERS, address: step, count: 1, bytes: &marker },
                Write { area: REGISTERS, address: STEPS, count: 1000, bytes: &large },
            ];
            let sender = sender.clone();
            let done = Box::new(move |outcome: Outcome| sender.send((step, outcome)).unwrap());
            node.memory.submit(Access::Client, Operation::Write(&writes), done).unwrap();
        }
        let outcomes: Vec<(u16, Outcome)> = receiver.iter().take(usize::from(STEPS)).collect();
        let mut confirmed = 0;
        for (step, outcome) in outcomes {
            let has_it = node.read(step) == Ok(number);
            match outcome {
                Ok(_) => assert!(has_it, "step {step} was confirmed"),
                Err(refused) => {
                    assert_eq!((refused.refusal, has_it), (Refusal::Unavailable, false))
                }
            }
            confirmed += usize::from(has_it);
        }
        confirmed
    };
    let (mut number, mut confirmed) = (0, 0);
    until("a message is too large", || {
        number += 1;
        confirmed += round(number);
        has_lowered_limit(&node)
    });
    until("all steps are confirmed", || {
        number += 1;
        let of_round = round(number);
        confirmed += of_round;
        of_round == usize::from(STEPS)
    });
    assert_eq!(node.status().steps, confirmed as u64);
    assert_eq!(node.status().not_confirmed, 0);
}

#[test]
fn nothing_is_made_on_a_server_that_is_too_old() {
    let server = Server::new();
    let old = introduced(&server, "version", &serde_json::json!("2.9.25"));
    let node = || Node::new(&[], "a", |settings| settings.servers.urls = vec![old.clone()]);
    let needed = "the server is nats-server 2.9.25: a log requires 2.10 or newer".to_owned();
    assert_eq!(node().try_start(), Err(LogError::Settings(needed)));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        assert_eq!(jetstream.stream_names().count().await, 0);
    });
    // A leaf node may be older than the servers that have the log.
    drop(Node::started(&[&server], "b"));
    node().start();
}

/// The subjects of all that the bucket of the snapshots has.
fn object_subjects(server: &Server) -> HashSet<String> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let stream = jetstream.get_stream("OBJ_holdfast-log-site").await.unwrap();
        let stored = stream.info_with_subjects("$O.>").await.unwrap();
        stored.map_ok(|(subject, _)| subject).try_collect().await.unwrap()
    })
}

#[test]
fn a_log_without_room_goes_on_behind_its_newest_snapshot() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", |settings| settings.snapshot_steps = 20);
    node.start();
    until("a snapshot is stored", || {
        node.write(0, 1).unwrap();
        node.status().snapshot.is_some_and(|sequence| sequence > 1)
    });
    fill(&server);
    node.write_at_last(0, 2);
    assert!(first_sequence(&server) > 1);
    let b = Node::started(&[&server], "b");
    assert_eq!(b.read(0), Ok(2));
}

#[test]
fn a_node_that_starts_says_that_the_log_has_no_room() {
    let server = Server::new();
    drop(Node::started(&[&server], "a"));
    fill(&server);
    let node = Node::new(&[&server], "a", |_| {});
    node.log.start().unwrap();
    until("it says why nothing is confirmed", || {
        let error = node.status().last_error.unwrap_or_default();
        error.starts_with("the log has confirmed nothing for ")
            && error.ends_with(" s: the stream refuses messages: maximum bytes exceeded")
    });
}

/// From now on, the stream has no room for further messages.
fn fill(server: &Server) {
    change_stream(server, "holdfast-log-site", |info| {
        info.config.max_bytes = info.state.bytes as i64;
    });
}

fn change_stream(server: &Server, name: &str, change: impl FnOnce(&mut Info)) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let mut info = jetstream.get_stream(name).await.unwrap().cached_info().clone();
        change(&mut info);
        jetstream.update_stream(info.config).await.unwrap();
    });
}

#[test]
fn a_node_says_which_permission_it_lacks() {
    for denied in ["holdfast.log.Site.steps", "$JS.API.STREAM.INFO.holdfast-log-Site"] {
        let folder = Folder::new();
        let file = folder.0.join("nats.conf");
        let permissions = format!("{{publish: {{deny: {denied:?}}}}}");
        let user = format!("{{user: a, password: b, permissions: {permissions}}}");
        let text = format!("no_auth_user: a, authorization: {{users: [{user}]}}");
        std::fs::write(&file, text).unwrap();
        let options = ["-c".to_owned(), file.to_str().unwrap().to_owned()];
        let server = Server::with(free_port(), &options);
        let node = Node::new(&[&server], "a", |settings| settings.name = "Site".to_owned());
        node.log.start().unwrap();
        let said = format!("Permissions Violation for Publish to {denied:?}");
        let mut events = Vec::new();
        until("its log says so", || {
            events.append(&mut node.log.take_events(Duration::ZERO));
            events.iter().any(|event| {
                matches!(event.name, "log_error" | "log_connect_failed")
                    && event.fields.iter().any(|(_, reason)| reason.contains(&said))
            })
        });
        assert!(node.status().last_error.unwrap().contains(&said));
    }
}

/// The servers may only be cut off from those that have the log. And a new stream would hide that it is lost.
#[test]
fn a_node_that_runs_makes_no_stream_in_place_of_a_lost_one() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    let other = Node::new(&[&server], "b", |settings| settings.max_cut_off = Duration::ZERO);
    other.start();
    node.write(0, 42).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let jetstream = runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        jetstream.delete_stream("holdfast-log-site").await.unwrap();
        jetstream
    });
    until("both notice it", || {
        let error = node.status().last_error.unwrap_or_default();
        error.contains("do not have the stream of the log any more") && other.failure().is_some()
    });
    assert_eq!(other.failure().unwrap().kind(), "replaced");
    assert_eq!((node.read(0), other.read(0)), (Ok(42), Err(Refusal::Differs)));
    assert!(runtime.block_on(jetstream.get_stream("holdfast-log-site")).is_err());
}

fn delete_stream(server: &Server, name: &str) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        async_nats::jetstream::new(client).delete_stream(name).await.unwrap();
    });
}

/// Whoever may delete what the log keeps beside its steps can't make it unusable while a node runs.
#[test]
fn snapshots_are_stored_again_after_a_bucket_of_the_log_was_deleted() {
    let server = Server::new();
    let soon = |settings: &mut Settings| settings.snapshot_steps = 20;
    let nodes = ["a", "b"].map(|name| Node::new(&[&server], name, soon));
    nodes.iter().for_each(Node::start);
    let mut value = 0;
    let mut until_stored = |what: &str| {
        let applied = nodes[0].status().sequence;
        until(what, || {
            value += 1;
            let _ = nodes[0].write(0, value);
            nodes.iter().all(|node| node.status().snapshot.is_some_and(|at| at > applied))
        });
    };
    until_stored("a snapshot is stored");
    for bucket in ["KV_holdfast-log-site", "OBJ_holdfast-log-site", "KV_holdfast-log-site-leases"] {
        delete_stream(&server, bucket);
        until_stored(bucket);
        nodes[1].write_at_last(1, 7);
        let new = Node::started(&[&server], "c");
        assert_eq!(new.read(1), Ok(7), "{bucket}");
    }
}

/// Removes messages of a stream as an operator may, or its limits do.
fn purge_stream(server: &Server, name: &str) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        jetstream.get_stream(name).await.unwrap().purge().await.unwrap();
    });
}

/// Nothing tells a node that the key is gone: it looks.
#[test]
fn the_key_of_the_snapshot_is_made_anew_when_it_was_purged() {
    let server = Server::new();
    let soon = |settings: &mut Settings| settings.examine_every = Duration::from_millis(100);
    let node = Node::new(&[&server], "a", soon);
    node.start();
    node.write(0, 7).unwrap();
    purge_stream(&server, "KV_holdfast-log-site");
    let mut events = Vec::new();
    until("the node says so, and makes it anew", || {
        events.extend(node.log.take_events(Duration::ZERO));
        let reason = |what: &str| {
            events.iter().any(|event| event.fields.iter().any(|(_, value)| value.starts_with(what)))
        };
        reason("the key of the snapshot is missing") && reason("keys of the log")
    });
    assert_eq!(Node::started(&[&server], "b").read(0), Ok(7));
}

/// As `nats kv del` does, or whoever may write to the bucket.
#[test]
fn the_key_of_the_snapshot_is_made_anew_when_it_was_deleted_or_malformed() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    for (headers, value) in
        [("NATS/1.0\r\nKV-Operation: DEL\r\n\r\n", ""), ("NATS/1.0\r\n\r\n", "not JSON")]
    {
        let subject = b"$KV.holdfast-log-site.snapshot";
        publish_raw(&server, subject, headers.as_bytes(), value.as_bytes());
        until("it is made anew", || {
            assert_eq!(node.failure(), None);
            node.log.take_events(Duration::ZERO).iter().any(|event| {
                event.name == "log_error" && event.fields[0].1.starts_with("keys of the log")
            })
        });
        node.write_at_last(0, 7);
        assert_eq!(Node::started(&[&server], "b").read(0), Ok(7));
    }
}

/// Messages of further nodes would be ignored by all.
#[test]
fn a_log_that_has_had_as_many_nodes_as_it_may_takes_no_other() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    node.write(0, 7).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        for number in 1..1024 {
            let message = beginning(&format!("pod-{number}"), 1).into();
            jetstream.publish("holdfast.log.site.steps", message).await.unwrap().await.unwrap();
        }
    });
    let error = Node::new(&[&server], "b", |_| {}).try_start().unwrap_err();
    assert_eq!(error.kind(), "too_many_nodes");
    assert!(error.to_string().starts_with("the log has had 1024 nodes"), "{error}");
    assert_eq!(Node::started(&[&server], "pod-3").read(0), Ok(7));
    node.write_at_last(0, 8);
}

/// The bucket of leases of the log `site` is `holdfast-log-site-leases`.
#[test]
fn a_log_has_no_name_that_ends_as_buckets_of_another_log_do() {
    for (name, node, expected) in [
        (
            "site-leases",
            "a",
            "name is \"site-leases\", allowed: a name that does not end in -leases",
        ),
        ("site-devices", "a", "allowed: a name that does not end in -devices"),
        ("site.a", "a", "name is \"site.a\", allowed: 1 to 64 letters, digits, - and _"),
        ("site", "a.plant", "node is \"a.plant\", allowed: 1 to 64 letters, digits, - and _"),
    ] {
        let settings = Settings::new(name, node, vec!["nats://127.0.0.1:1".to_owned()]);
        let error = settings.check().unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    for name in ["site", "leases", "site-leases-2", "site_devices"] {
        let settings = Settings::new(name, "a-leases", vec!["nats://127.0.0.1:1".to_owned()]);
        assert_eq!(settings.check(), Ok(()));
    }
}

/// As after a restore that was cut short: it restores the key last.
#[test]
fn a_log_with_messages_and_without_the_key_of_its_snapshot_is_not_begun_anew() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    node.write(0, 42).unwrap();
    drop(node);
    for bucket in ["KV_holdfast-log-site", "OBJ_holdfast-log-site"] {
        delete_stream(&server, bucket);
        let node = Node::new(&[&server], "a", |settings| settings.max_cut_off = Duration::ZERO);
        let error = node.try_start().unwrap_err();
        assert_eq!(error.kind(), "snapshot");
        assert!(error.to_string().ends_with("or a restore was cut short"), "{error}");
        assert_eq!(node.read(0), Err(Refusal::Differs));
    }
}

fn first_sequence(server: &Server) -> u64 {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let stream = jetstream.get_stream("holdfast-log-site").await.unwrap();
        stream.cached_info().state.first_sequence
    })
}

#[test]
fn a_restarted_node_goes_on_where_it_was() {
    let server = Server::new();
    let a = Node::started(&[&server], "a");
    a.write(0, 1).unwrap();
    drop(a);
    let a = Node::started(&[&server], "a");
    assert_eq!(a.read(0), Ok(1));
    a.write(0, 2).unwrap();
    drop(a);
    let b = Node::started(&[&server], "b");
    assert_eq!(b.read(0), Ok(2));
}

/// Notes how old the values are that a range gets.
#[derive(Debug, Default)]
struct Ages(Mutex<Vec<Duration>>);

impl Freshness for Ages {
    fn renew(&self, age: Duration, _: Option<u64>) {
        self.0.lock().unwrap().push(age);
    }

    fn must_refuse(&self) -> bool {
        false
    }
}

/// Watches register 3.
fn watched(node: &Node) -> Arc<Ages> {
    let ages = Arc::new(Ages::default());
    let freshness = Some(Arc::clone(&ages) as Arc<dyn Freshness>);
    let range = Mirrored { freshness, ..Mirrored::reserved(REGISTERS, 3, 1) };
    node.memory.mirror(vec![range]).unwrap();
    ages
}

fn mirror(node: &Node, value: u16) {
    let bytes = value.to_be_bytes();
    let write = Write { area: REGISTERS, address: 3, count: 1, bytes: &bytes };
    node.memory.write(Access::Mirror, write).unwrap();
}

/// Mirrors a value under a lease that was taken at this revision.
fn mirror_under(lease: u64, since: u64, node: &Node, value: u16) -> Result<(), Refusal> {
    let bytes = value.to_be_bytes();
    let write = Write { area: REGISTERS, address: 3, count: 1, bytes: &bytes };
    let (sender, receiver) = std::sync::mpsc::channel();
    let done = Box::new(move |outcome: Outcome| drop(sender.send(outcome)));
    let tenure = Some(Tenure { lease, term: Term { epoch: 0, since } });
    node.memory.submit_under(tenure, Access::Mirror, Operation::Write(&[write]), done)?;
    receiver.recv().unwrap().map(|_| ()).map_err(|refused| refused.refusal)
}

#[test]
fn what_a_former_holder_of_a_lease_writes_late_is_refused() {
    const LEASE: u64 = 7;
    let server = Server::new();
    let soon = |settings: &mut Settings| settings.snapshot_steps = 20;
    let [a, b] = ["a", "b"].map(|name| Node::new(&[&server], name, soon));
    a.start();
    b.start();
    let late = || mirror_under(LEASE, 10, &a, 4);
    assert_eq!(mirror_under(LEASE, 10, &a, 1), Ok(()));
    assert_eq!(mirror_under(LEASE, 10, &a, 2), Ok(()));
    assert_eq!(mirror_under(LEASE, 11, &b, 3), Ok(()));
    assert_eq!(late(), Err(Refusal::Overtaken));
    assert_eq!(mirror_under(LEASE, 11, &b, 5), Ok(()));
    assert_eq!(mirror_under(LEASE + 1, 10, &a, 5), Ok(()), "that is another lease");
    let memory = memory_of(100);
    let settings = Settings::new("site", "replay", vec![server.url()]);
    let members = vec![("plant".to_owned(), memory)];
    let mut reader = LogReader::open(&settings, members, Until::Now, nodes::DEADLINE).unwrap();
    let mut refusals = Vec::new();
    while let Some(record) = reader.next(nodes::DEADLINE).unwrap() {
        refusals.extend(record.refusals.into_iter().flatten());
    }
    assert_eq!(refusals, [Refusal::Overtaken]);
    // Whoever begins with a snapshot knows the term too.
    until("a snapshot is taken", || {
        b.write(0, 1).unwrap();
        first_sequence(&server) > 1
    });
    let c = Node::started(&[&server], "c");
    assert_eq!(late(), Err(Refusal::Overtaken));
    c.until_applied(a.status().last_sequence);
    assert_eq!((c.read(3), a.read(3), b.read(3)), (Ok(5), Ok(5), Ok(5)));
    assert_eq!(mirror_under(LEASE, 12, &a, 6), Ok(()), "it has the lease again");
    assert_eq!(mirror_under(LEASE, 11, &b, 5), Err(Refusal::Overtaken));
    c.until_applied(a.status().last_sequence);
    assert_eq!(c.read(3), Ok(6));
}

#[test]
fn values_of_a_device_that_a_node_replays_have_no_age_and_later_ones_that_of_the_contact() {
    let server = Server::new();
    let a = Node::started(&[&server], "a");
    mirror(&a, 7);
    let b = Node::new(&[&server], "b", |settings| settings.max_lag = Duration::from_secs(3600));
    let of_b = watched(&b);
    b.start();
    assert_eq!(b.read(3), Ok(7));
    assert!(of_b.0.lock().unwrap().is_empty(), "nobody knows how old the value is");
    // The last message of the node is the one with which it has caught up.
    let (began, passed) = (Instant::now(), Duration::from_millis(20));
    until("time passes", || began.elapsed() > passed);
    let (of_a, began) = (watched(&a), Instant::now());
    mirror(&a, 8);
    until("the other node has it", || b.read(3) == Ok(8));
    let (of_a, of_b) = (of_a.0.lock().unwrap(), of_b.0.lock().unwrap());
    assert!(of_a.len() == 1 && of_a[0] <= began.elapsed(), "{of_a:?}");
    assert!(of_b.len() == 1 && of_b[0] >= passed, "{of_b:?}");
    drop(of_a);
    // The node that has sent the value replays it too.
    drop(a);
    let a = Node::new(&[&server], "a", |_| {});
    let of_a = watched(&a);
    a.start();
    assert_eq!(a.read(3), Ok(8));
    assert!(of_a.0.lock().unwrap().is_empty());
}

/// Digests are compared often.
fn often(settings: &mut Settings) {
    settings.digest_steps = 5;
}

/// As before, and a node whose contents are wrong does not return by itself.
fn for_good(settings: &mut Settings) {
    often(settings);
    settings.rejoin_after = None;
}

fn corrupt(node: &Node) {
    step(90, 666).carry_out(std::slice::from_ref(&node.memory)).unwrap();
}

fn told(node: &Node, name: &str) -> bool {
    node.log.take_events(Duration::ZERO).iter().any(|event| event.name == name)
}

#[test]
fn a_node_that_applied_something_wrongly_returns_once_with_the_contents_of_the_log() {
    let server = Server::new();
    let nodes = ["a", "b", "c"].map(|name| Node::new(&[&server], name, often));
    nodes.iter().for_each(Node::start);
    let [good, wrong, _] = &nodes;
    corrupt(wrong);
    until("the node notices it", || {
        good.write(1, 2).unwrap();
        told(wrong, "log_contents_dropped")
    });
    until("the node returns", || {
        let read = wrong.read(90);
        assert_ne!(read, Ok(666), "wrong contents are not served again");
        read == Ok(0)
    });
    assert!(told(wrong, "log_contents_restored"));
    assert_eq!(wrong.status().phase, Phase::Running);
    wrong.write(2, 3).unwrap();
    until("the others have its write", || good.read(2) == Ok(3));
    corrupt(wrong);
    until("the node stops", || {
        good.write(1, 2).unwrap();
        wrong.failure().is_some()
    });
    assert_eq!(wrong.failure().unwrap().kind(), "differs");
    assert_eq!(wrong.read(90), Err(Refusal::Differs));
    assert_eq!(good.failure(), None);
}

/// Without another node that compares itself, the log decides.
#[test]
fn a_node_that_is_alone_returns_when_the_log_confirms_its_contents() {
    let server = Server::new();
    let alone = Node::new(&[&server], "a", often);
    alone.start();
    drop(Node::started(&[&server], "b"));
    corrupt(&alone);
    until("it has a digest of the wrong contents", || {
        alone.write(1, 2).unwrap();
        alone.status().digest.is_some()
    });
    let sequence = alone.status().digest.unwrap().sequence;
    let told_by_other = format!(r#"{{"sequence": {sequence}, "digest": "{}"}}"#, "0".repeat(64));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let keys = jetstream.get_key_value("holdfast-log-site").await.unwrap();
        keys.put("digest.b", told_by_other.into()).await.unwrap();
    });
    until("the node notices it", || told(&alone, "log_contents_dropped"));
    until("the node returns", || {
        let read = alone.read(90);
        assert_ne!(read, Ok(666), "wrong contents are not served again");
        read == Ok(0)
    });
    assert_eq!(alone.read(1), Ok(2));
    alone.write(2, 3).unwrap();
}

#[test]
fn a_node_that_applied_something_wrongly_stops_serving() {
    let server = Server::new();
    let nodes = ["a", "b", "c"].map(|name| Node::new(&[&server], name, for_good));
    nodes.iter().for_each(Node::start);
    nodes[0].write(0, 1).unwrap();
    corrupt(&nodes[1]);
    until("the node notices it", || {
        // Digests are compared while the log goes on.
        nodes[0].write(1, 2).unwrap();
        nodes[1].failure().is_some()
    });
    let error = nodes[1].failure().unwrap();
    assert!(matches!(error, LogError::Differs { .. }), "{error}");
    assert_eq!(nodes[1].read(0), Err(Refusal::Differs));
    assert_eq!(nodes[1].write(0, 3), Err(Refusal::Differs));
    for good in [&nodes[0], &nodes[2]] {
        good.write(5, 9).unwrap();
        assert_eq!(good.failure(), None);
    }
}

/// Without a majority, the log decides.
#[test]
fn of_two_nodes_the_one_that_the_log_does_not_lead_to_stops_serving() {
    for wrong in [0, 1] {
        let server = Server::new();
        let nodes = ["a", "b"].map(|name| Node::new(&[&server], name, for_good));
        nodes.iter().for_each(Node::start);
        corrupt(&nodes[wrong]);
        let good = &nodes[1 - wrong];
        until("the node notices it", || {
            good.write(1, 2).unwrap();
            nodes[wrong].failure().is_some()
        });
        assert_eq!(nodes[wrong].failure().unwrap().kind(), "differs");
        assert_eq!(good.failure(), None);
        good.write(1, 3).unwrap();
    }
}

/// Otherwise those who load it would be wrong as well.
#[test]
fn wrong_contents_do_not_become_a_snapshot() {
    let server = Server::new();
    let soon = |settings: &mut Settings| {
        settings.rejoin_after = None;
        settings.snapshot_steps = 5;
    };
    let (good, wrong) = (Node::started(&[&server], "a"), Node::new(&[&server], "b", soon));
    wrong.start();
    corrupt(&wrong);
    until("the node notices it", || {
        good.write(1, 2).unwrap();
        wrong.failure().is_some()
    });
    assert_eq!(wrong.failure().unwrap().kind(), "differs");
    assert_eq!(good.failure(), None);
    assert_eq!(Node::started(&[&server], "c").read(90), Ok(0));
}

#[test]
fn equal_nodes_have_equal_digests() {
    let server = Server::new();
    let nodes = ["a", "b"].map(|name| Node::new(&[&server], name, often));
    nodes.iter().for_each(Node::start);
    until("digests agree", || {
        nodes[0].write(1, 2).unwrap();
        nodes.iter().all(|node| node.status().digest.is_some_and(|own| own.agrees == Some(true)))
    });
}

#[test]
fn without_contact_reads_are_refused_if_that_is_wanted() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", |settings| {
        settings.refuses_when_behind = true;
        settings.max_lag = Duration::from_secs(5);
    });
    let other = Node::started(&[&server], "b");
    assert_eq!(node.read(0), Err(Refusal::Behind), "before the first contact");
    node.start();
    node.write(0, 1).unwrap();
    assert_eq!(node.read(0), Ok(1));
    until("the other node has it", || other.read(0) == Ok(1));
    server.signal("STOP");
    until("reads are refused", || node.read(0) == Err(Refusal::Behind));
    assert_eq!(other.read(0), Ok(1), "the other node serves");
    server.signal("CONT");
    until("reads are served", || node.read(0) == Ok(1));
}

#[test]
fn two_processes_with_the_name_of_a_node_are_noticed() {
    let server = Server::new();
    let first = Node::started(&[&server], "a");
    let second = Node::started(&[&server], "a");
    until("the first one stops", || first.failure().is_some());
    assert_eq!(first.failure().unwrap().kind(), "name_taken");
    assert_eq!(first.read(0), Err(Refusal::Differs));
    second.write(0, 1).unwrap();
}

#[test]
fn of_two_processes_with_one_name_that_start_at_once_one_goes_on() {
    let server = Server::new();
    let nodes = [(); 2].map(|()| Node::new(&[&server], "a", |_| {}));
    nodes.iter().for_each(|node| node.log.start().unwrap());
    until("one stops, and the other one has caught up", || {
        let [one, other] = nodes.each_ref().map(|node| node.status().phase);
        matches!(
            (one, other),
            (Phase::Failed(_), Phase::Running) | (Phase::Running, Phase::Failed(_))
        )
    });
    for node in &nodes {
        match node.failure() {
            Some(error) => assert_eq!(error.kind(), "name_taken"),
            None => node.write(0, 1).unwrap(),
        }
    }
}

/// The message with which a node begins, as one with this start sends it.
fn beginning(node: &str, start: u64) -> Vec<u8> {
    let mut bytes = b"HFL\x01\x00".to_vec();
    bytes.push(node.len() as u8);
    bytes.extend_from_slice(node.as_bytes());
    bytes.extend_from_slice(&start.to_le_bytes());
    bytes.extend_from_slice(&1_u64.to_le_bytes());
    bytes
}

#[test]
fn a_node_starts_whatever_the_clock_has_shown_before() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    node.write(0, 1).unwrap();
    drop(node);
    // Starts were times once: here of clocks that were in the year 2100, and then before.
    for seconds in [4_102_444_800, 4_102_444_770, 1_u64] {
        let start = seconds * 1_000_000;
        publish_raw(&server, STEPS, b"NATS/1.0\r\n\r\n", &beginning("a", start));
        let node = Node::started(&[&server], "a");
        assert_eq!(node.read(0), Ok(1));
        node.write(1, 2).unwrap();
    }
    publish_raw(&server, STEPS, b"NATS/1.0\r\n\r\n", &beginning("a", u64::MAX));
    let error = Node::new(&[&server], "a", |_| {}).try_start().unwrap_err();
    assert!(error.to_string().contains("rename the node"), "{error}");
}

#[test]
fn a_server_that_has_lost_messages_is_not_followed() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    node.write(0, 1).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        jetstream.delete_stream("holdfast-log-site").await.unwrap();
    });
    until("the node stops", || node.failure().is_some());
    assert_eq!(node.failure().unwrap().kind(), "replaced");
    assert_eq!(node.read(0), Err(Refusal::Differs));
}

#[test]
fn a_server_that_was_set_back_is_not_followed() {
    let mut server = Server::new();
    let a = Node::started(&[&server], "a");
    a.write(0, 1).unwrap();
    server.kill();
    server.copy("store", "copy");
    server.start();
    for value in 2..12 {
        a.write_at_last(0, value);
    }
    let applied = a.status().sequence;
    server.kill();
    server.copy("copy", "store");
    server.start();
    let b = Node::started(&[&server], "b");
    assert_eq!(b.read(0), Ok(1));
    until("the node stops", || {
        b.write(1, 1).unwrap();
        a.failure().is_some()
    });
    assert!(b.status().sequence >= applied, "until then, it may be a server that is cut off");
    assert_eq!(a.failure().unwrap().kind(), "replaced");
    assert_eq!(a.read(0), Err(Refusal::Differs));
    b.write(2, 2).unwrap();
}

/// The server still knows of the message, so it seems to come.
#[test]
fn a_node_that_starts_says_that_the_last_message_of_the_log_is_missing() {
    let mut server = Server::new();
    let node = Node::started(&[&server], "a");
    node.write(0, 1).unwrap();
    drop(node);
    server.stop();
    server.cut_messages(5);
    server.start();
    let node = Node::new(&[&server], "a", |_| {});
    node.log.start().unwrap();
    until("the node says what is missing", || {
        let error = node.status().last_error.unwrap_or_default();
        error.starts_with("message") && error.contains("missing: only a new snapshot")
    });
}

/// Puts other bytes in place of the snapshots whose names are chosen.
fn damage(server: &Server, chosen: impl Fn(&[String]) -> Vec<String>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let objects = jetstream.get_object_store("holdfast-log-site").await.unwrap();
        let mut names = Vec::new();
        let mut list = objects.list().await.unwrap();
        while let Some(object) = list.next().await {
            names.push(object.unwrap().name);
        }
        names.sort_by_key(|name| name.split('-').next().unwrap().parse::<u64>().unwrap());
        for name in chosen(&names) {
            objects.put(name.as_str(), &mut &b"damaged"[..]).await.unwrap();
        }
    });
}

#[test]
fn a_damaged_snapshot_is_never_loaded() {
    let server = Server::new();
    let node = Node::new(&[&server], "a", |settings| settings.snapshot_steps = 5);
    node.start();
    let mut value = 0;
    until("two snapshots are taken", || {
        value += 1;
        node.write(0, value).unwrap();
        first_sequence(&server) > 1
    });
    drop(node);
    damage(&server, |names| names.last().cloned().into_iter().collect());
    let node = Node::started(&[&server], "b");
    assert_eq!(node.read(0), Ok(value), "the one before it is loaded");
    let events = node.log.take_events(Duration::ZERO);
    assert!(events.iter().any(|event| event.name == "log_snapshot_damaged"), "{events:?}");
    drop(node);
    damage(&server, <[String]>::to_vec);
    let node = Node::new(&[&server], "c", |_| {});
    let error = node.try_start().unwrap_err();
    assert_eq!(error.kind(), "snapshot");
    assert!(error.to_string().contains("its digest is"), "{error}");
    assert!(error.to_string().contains(": only the next snapshot of a node that runs helps"));
    assert_eq!(node.read(0), Err(Refusal::Differs), "nor is it empty");
}

/// A node does not know what such a message does to the contents.
#[test]
fn a_message_of_a_newer_version_stops_a_node() {
    let server = Server::new();
    let node = Node::started(&[&server], "a");
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let publish = jetstream.publish("holdfast.log.site.steps", "HFL\u{9}new".into());
        publish.await.unwrap().await.unwrap();
    });
    until("the node stops", || node.failure().is_some());
    let error = node.failure().unwrap();
    assert_eq!(error.kind(), "version");
    let expected = "a message of the log has version 9, supported is 4: update this node";
    assert_eq!(error.to_string(), expected);
    assert_eq!(node.read(0), Err(Refusal::Differs));
}

#[test]
fn a_step_that_no_message_holds_is_refused() {
    let server = Server::with(nodes::free_port(), &[]);
    let memory = memory_of(65_536);
    let nodes = [Node::with(memory, &[&server], "a", |_| {})];
    nodes[0].start();
    let bytes = vec![1; 131_072];
    let write = Write { area: REGISTERS, address: 0, count: 65_536, bytes: &bytes };
    nodes[0].memory.write(Access::Ingest, write).unwrap();
    let writes = vec![write; 9];
    let refused = nodes[0].memory.write_many(Access::Ingest, &writes).unwrap_err();
    let Refusal::TooLarge { bytes: found, most } = refused.refusal else { panic!("{refused}") };
    assert!(found > 9 * bytes.len() && (bytes.len()..9 * bytes.len()).contains(&most), "{refused}");
    assert_eq!(nodes[0].status().too_large, 1);
}

/// A process that was stopped has old contents when it goes on, and its connection looks sound.
#[test]
fn a_node_that_was_stopped_serves_no_old_value() {
    let server = Server::new();
    let arguments = |options: &[&str]| {
        let arguments = [server.url(), "1".to_owned()].into_iter();
        arguments.chain(options.iter().map(|option| (*option).to_owned())).collect()
    };
    let writer = Process::new("writer", arguments(&[]));
    let reader = Process::new("reader", arguments(&["refuse"]));
    writer.start();
    reader.start();
    for round in 1..=3 {
        until("the reader has the value", || {
            let last = (round - 1).to_string();
            reader.ask("read 0", nodes::DEADLINE) == Answer::Ok(last)
        });
        reader.signal("STOP");
        let written = writer.ask(&format!("write 0 {round}"), nodes::DEADLINE);
        assert_eq!(written, Answer::Ok("0".to_owned()));
        // Longer than the `max_lag` of the process.
        let stopped = Instant::now();
        until("the contents are too old", || stopped.elapsed() > Duration::from_millis(1500));
        let reads: Vec<_> = (0..100).filter_map(|_| reader.send("read 0")).collect();
        reader.signal("CONT");
        let answers: Vec<Answer> =
            reads.iter().map(|read| Answer::of(read, nodes::DEADLINE)).collect();
        let is_right = |answer: &Answer| {
            *answer == Answer::Refused || *answer == Answer::Ok(round.to_string())
        };
        assert!(answers.iter().all(is_right), "{answers:?}");
    }
}

#[test]
fn a_cluster_goes_on_without_one_of_its_servers() {
    let mut servers = cluster(3);
    let of_three = |settings: &mut holdfast_journal::log::Settings| settings.replicas = 3;
    let (a, b) = {
        let all: Vec<&Server> = servers.iter().collect();
        (Node::new(&all, "a", of_three), Node::new(&all, "b", of_three))
    };
    a.start();
    b.start();
    assert_eq!(a.status().replicas, 3);
    for (round, server) in servers.iter_mut().take(2).enumerate() {
        let round = round as u16;
        server.kill();
        a.write_at_last(round, 10 + round);
        b.write_at_last(10 + round, 20 + round);
        until("both have both", || {
            b.read(round) == Ok(10 + round) && a.read(10 + round) == Ok(20 + round)
        });
        server.start();
    }
    assert_eq!(a.all(), b.all());
}
