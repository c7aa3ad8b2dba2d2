//! Nodes and servers that are killed, stopped and started again at random, while clients write and
//! read. What the clients saw is judged by Porcupine, a checker of linearizability.
//!
//! The short form runs for some seconds. With `HOLDFAST_TORTURE=1` each form runs for ten minutes;
//! `HOLDFAST_TORTURE_SECONDS` sets another time, `HOLDFAST_TORTURE_SEED` the seed.

mod nodes;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use holdfast_journal::log::{LogReader, Settings, Until};
use holdfast_memory::{Action, Area, Layout, Memory, Span};
use nodes::process::{Answer, Process};
use nodes::{Server, cluster, until};

/// Registers of a node that are in use at one time. After an epoch, others are.
const REGISTERS: u64 = 4;
const CLIENTS: u64 = 4;
const EPOCH: Duration = Duration::from_secs(3);

/// How long a client waits for an answer. A stopped node answers later, or never.
const TIMEOUT: Duration = Duration::from_secs(2);

struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        // SplitMix64.
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, end: u64) -> u64 {
        self.next() % end
    }

    /// 1 to `most` different numbers below `end`.
    fn some(&mut self, most: u64, end: usize) -> Vec<usize> {
        let mut all: Vec<usize> = (0..end).collect();
        let count = 1 + self.below(most.min(end as u64));
        (0..count).map(|_| all.swap_remove(self.below(all.len() as u64) as usize)).collect()
    }
}

#[derive(Debug)]
struct Operation {
    register: u64,
    client: u64,
    is_write: bool,
    value: u16,
    called: Duration,
    returned: Option<Duration>,
    /// Of a write: whether it was refused, so that it has done nothing.
    refused: bool,
}

/// What nodes, clients and the disturber share.
struct Run {
    nodes: Vec<Process>,
    urls: Vec<String>,
    began: Instant,
    history: Mutex<Vec<Operation>>,
    stopping: AtomicBool,
}

impl Run {
    fn new(servers: &[Server], nodes: usize, options: &[&str]) -> Run {
        let urls: Vec<String> = servers.iter().map(Server::url).collect();
        let replicas = if servers.len() == 1 { 1 } else { 3 };
        let mut arguments = vec![urls.join(","), replicas.to_string()];
        arguments.extend(options.iter().map(|option| (*option).to_owned()));
        let nodes: Vec<Process> =
            (0..nodes).map(|index| Process::new(&format!("n{index}"), arguments.clone())).collect();
        std::thread::scope(|scope| {
            for node in &nodes {
                scope.spawn(|| node.start());
            }
        });
        let (history, stopping) = (Mutex::default(), AtomicBool::new(false));
        Run { nodes, urls, began: Instant::now(), history, stopping }
    }

    /// Lets clients work while at most so many servers and nodes are disturbed at a time. Then reads
    /// everything on all nodes.
    fn work(&self, most: u64, servers: &mut [Server], time: Duration, seed: u64) {
        println!("seed {seed}");
        let values = AtomicU64::new(0);
        let mut random = Random(seed);
        std::thread::scope(|scope| {
            for client in 0..self.nodes.len() as u64 * CLIENTS {
                let (values, seed) = (&values, random.next());
                scope.spawn(move || self.client(client, values, seed));
            }
            match most {
                0 => std::thread::sleep(time),
                most => self.disturb(most, servers, time, random.next()),
            }
            self.stopping.store(true, Ordering::Release);
        });
        let registers: BTreeSet<u64> =
            self.history.lock().unwrap().iter().map(|operation| operation.register).collect();
        for (node, process) in self.nodes.iter().enumerate() {
            // A register that no client uses. Behind this write, the node has all writes before it.
            let write = format!("write {} 1", 65_000 + node);
            until("the node writes again", || {
                matches!(process.ask(&write, nodes::DEADLINE), Answer::Ok(_))
            });
        }
        for node in 0..self.nodes.len() {
            for register in &registers {
                let client = 1000 + node as u64;
                assert!(matches!(self.operate(node, client, *register, None), Answer::Ok(_)));
            }
        }
    }

    /// Writes and reads registers of one node until the end. No other node writes these.
    fn client(&self, client: u64, values: &AtomicU64, seed: u64) {
        let mut random = Random(seed);
        let node = client / CLIENTS;
        while !self.stopping.load(Ordering::Acquire) {
            let epoch = self.began.elapsed().as_secs() / EPOCH.as_secs();
            let register =
                (epoch * self.nodes.len() as u64 + node) * REGISTERS + random.below(REGISTERS);
            // Unique among the writes to a register.
            let value = (1 + values.fetch_add(1, Ordering::Relaxed) % 65_535) as u16;
            let value = (random.below(2) == 0).then_some(value);
            self.operate(node as usize, client, register, value);
            std::thread::sleep(Duration::from_millis(1 + random.below(4)));
        }
    }

    fn operate(&self, node: usize, client: u64, register: u64, value: Option<u16>) -> Answer {
        let command = match value {
            Some(value) => format!("write {register} {value}"),
            None => format!("read {register}"),
        };
        let called = self.began.elapsed();
        let answer = self.nodes[node].ask(&command, TIMEOUT);
        let returned = self.began.elapsed();
        let (is_write, refused) = (value.is_some(), answer == Answer::Refused);
        let (value, returned) = match &answer {
            Answer::Ok(read) => (value.unwrap_or_else(|| read.parse().unwrap()), Some(returned)),
            // A read without an answer tells nothing.
            _ if !is_write => return answer,
            _ => (value.unwrap_or_default(), None),
        };
        let operation = Operation { register, client, is_write, value, called, returned, refused };
        self.history.lock().unwrap().push(operation);
        answer
    }

    /// Disturbs one kind after the other: at most so many nodes and servers at a time.
    fn disturb(&self, most: u64, servers: &mut [Server], time: Duration, seed: u64) {
        let mut random = Random(seed);
        let end = self.began + time;
        while Instant::now() < end {
            std::thread::sleep(Duration::from_millis(200 + random.below(1500)));
            let what = random.below(5);
            let nodes = random.some(most, self.nodes.len());
            let nodes: Vec<&Process> = nodes.into_iter().map(|node| &self.nodes[node]).collect();
            let chosen = random.some(most, servers.len());
            let long = Duration::from_millis(300 + random.below(2500));
            let at = self.began.elapsed().as_secs_f64();
            let named = ["kill nodes", "stop nodes", "kill servers", "stop servers", "both"];
            let names: Vec<&str> = nodes.iter().map(|node| &node.name[..]).collect();
            println!("{at:.1} {}: {names:?} {chosen:?} {long:?}", named[what as usize]);
            let signal = |name| nodes.iter().for_each(|node| node.signal(name));
            match what {
                0 => {
                    nodes.iter().for_each(|node| node.kill());
                    std::thread::sleep(long / 4);
                    nodes.iter().for_each(|node| node.start());
                }
                1 => {
                    signal("STOP");
                    std::thread::sleep(long);
                    signal("CONT");
                }
                2 => {
                    chosen.iter().for_each(|server| servers[*server].kill());
                    std::thread::sleep(long / 2);
                    chosen.iter().for_each(|server| servers[*server].start());
                }
                3 => {
                    chosen.iter().for_each(|server| servers[*server].signal("STOP"));
                    std::thread::sleep(long);
                    chosen.iter().for_each(|server| servers[*server].signal("CONT"));
                }
                _ => {
                    chosen.iter().for_each(|server| servers[*server].kill());
                    signal("STOP");
                    std::thread::sleep(long);
                    chosen.iter().for_each(|server| servers[*server].start());
                    signal("CONT");
                }
            }
        }
    }

    fn assert_equal_contents(&self) {
        let dumps = self.nodes.iter().map(|node| node.ask("dump", nodes::DEADLINE));
        let dumps: Vec<Answer> = dumps.collect();
        assert!(matches!(dumps[0], Answer::Ok(_)), "{dumps:?}");
        assert!(dumps.iter().all(|dump| *dump == dumps[0]), "nodes differ: {dumps:?}");
    }

    /// Compares the history with the stream: a confirmed write is there once, a refused one is not.
    fn assert_writes_are_in_the_log_once(&self) {
        let layout = Layout::default().with(Area::HoldingRegisters, Span::new(0, 65_536).unwrap());
        let memory = Arc::new(Memory::new(layout, None).unwrap());
        let settings = Settings::new("torture", "reader", self.urls.clone());
        let memories = vec![("plant".to_owned(), memory)];
        let mut reader = LogReader::open(&settings, memories, Until::Now, nodes::DEADLINE).unwrap();
        let mut found: BTreeMap<(u64, u16), u32> = BTreeMap::new();
        while let Some(record) = reader.next(nodes::DEADLINE).unwrap() {
            for step in record.steps.iter().filter(|_| record.fresh) {
                let Action::Write(writes) = &step.action else { panic!("{step:?}") };
                for write in writes {
                    let value = u16::from_be_bytes([write.bytes[0], write.bytes[1]]);
                    *found.entry((write.address.into(), value)).or_default() += 1;
                }
            }
        }
        assert!(reader.has_ended(), "the stream does not go on");
        println!("{} writes in the log, up to {}", found.len(), reader.sequence());
        let history = self.history.lock().unwrap();
        for write in history.iter().filter(|operation| operation.is_write) {
            let count = found.get(&(write.register, write.value)).copied().unwrap_or_default();
            match (write.returned, write.refused) {
                (Some(_), _) => assert_eq!(count, 1, "a confirmed write: {write:?}"),
                (None, true) => assert_eq!(count, 0, "a refused write: {write:?}"),
                (None, false) => assert!(count <= 1, "an unconfirmed write: {write:?}"),
            }
        }
    }

    /// Asks Porcupine whether each register behaved as one. Returns what it says.
    fn judge(&self) -> Result<String, String> {
        let mut text = String::new();
        let history = self.history.lock().unwrap();
        for operation in history.iter().filter(|operation| !operation.refused) {
            let Operation { register, client, is_write, value, called, returned, .. } = operation;
            let kind = if *is_write { 'w' } else { 'r' };
            let returned = returned.map_or(-1, |returned| returned.as_nanos() as i64);
            let called = called.as_nanos();
            writeln!(text, "{register} {client} {kind} {value} {called} {returned}").unwrap();
        }
        let confirmed = history.iter().filter(|one| one.is_write && one.returned.is_some()).count();
        let refused = history.iter().filter(|one| one.refused).count();
        let all = history.len();
        println!("{all} operations, {confirmed} confirmed writes, {refused} refused writes");
        assert!(confirmed > 100, "only {confirmed} writes were confirmed");
        let Some(checker) = checker() else { return Ok("not judged".to_owned()) };
        let mut checker =
            Command::new(checker).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        checker.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        let output = checker.wait_with_output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        println!("{said}");
        if output.status.success() { Ok(said) } else { Err(said) }
    }
}

/// Builds the checker. Without Go, nothing is judged on a developer's machine; CI has it.
fn checker() -> Option<PathBuf> {
    if Command::new("go").arg("version").output().is_err() {
        let is_ci = std::env::var("CI").is_ok_and(|ci| ci == "true");
        assert!(!is_ci, "Go is missing, and this is CI");
        println!("Go is missing: Porcupine does not judge");
        return None;
    }
    let program = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("checker");
    let built = Command::new("go")
        .args(["build", "-o"])
        .arg(&program)
        .arg(".")
        .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/checker"))
        .status();
    assert!(built.unwrap().success(), "the checker is built");
    Some(program)
}

fn time(short: u64) -> Duration {
    let set = std::env::var("HOLDFAST_TORTURE_SECONDS").ok().and_then(|text| text.parse().ok());
    let long = std::env::var_os("HOLDFAST_TORTURE").map(|_| 600);
    Duration::from_secs(set.or(long).unwrap_or(short))
}

fn seed(default: u64) -> u64 {
    let set = std::env::var("HOLDFAST_TORTURE_SEED").ok().and_then(|text| text.parse().ok());
    set.unwrap_or(default)
}

#[test]
fn no_write_is_lost_or_applied_twice_while_nodes_and_servers_die() {
    let mut servers = cluster(3);
    let run = Run::new(&servers, 3, &[]);
    run.work(1, &mut servers, time(15), seed(1));
    run.assert_equal_contents();
    run.judge().unwrap();
    run.assert_writes_are_in_the_log_once();
}

#[test]
fn the_same_with_two_failures_of_a_kind_at_once() {
    let mut servers = cluster(3);
    let run = Run::new(&servers, 3, &["snapshots"]);
    run.work(2, &mut servers, time(15), seed(5));
    run.assert_equal_contents();
    run.judge().unwrap();
}

#[test]
fn the_same_with_snapshots_and_purges() {
    let mut servers = cluster(3);
    let run = Run::new(&servers, 3, &["snapshots"]);
    run.work(1, &mut servers, time(15), seed(2));
    run.assert_equal_contents();
    run.judge().unwrap();
}

#[test]
fn the_same_with_one_server() {
    let mut servers = vec![Server::new()];
    let run = Run::new(&servers, 2, &["refuse"]);
    run.work(1, &mut servers, time(10), seed(3));
    run.assert_equal_contents();
    run.judge().unwrap();
    run.assert_writes_are_in_the_log_once();
}

/// A node that answers before its step is confirmed breaks the promise, and the checker sees it.
#[test]
fn the_checker_finds_writes_that_are_answered_too_early() {
    if checker().is_none() {
        return;
    }
    let mut servers = [Server::new()];
    let run = Run::new(&servers, 2, &["answers-early"]);
    run.work(0, &mut servers, Duration::from_secs(5), seed(4));
    let Err(said) = run.judge() else { panic!("nothing is found") };
    assert!(said.contains("not linearizable"), "{said}");
}
