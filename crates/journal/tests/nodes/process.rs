//! A node of a log in a process of its own, which a test can kill and stop.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{BufRead, BufReader, Write as _, stdin, stdout};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_journal::log::{Log, Settings};
use holdfast_memory::{
    Access, Area, Layout, Memory, Operation, Outcome, Read, Refusal, Span, Write,
};

use super::{DEADLINE, signal_to};

/// The environment variable with the arguments of a node.
const ARGUMENTS: &str = "HOLDFAST_LOG_NODE";

/// A node in a process of its own.
pub struct Process {
    pub name: String,
    arguments: Vec<String>,
    running: Mutex<Option<Running>>,
    next: AtomicU64,
}

struct Running {
    child: Child,
    input: ChildStdin,
    waiting: Arc<Mutex<HashMap<u64, Sender<String>>>>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    Ok(String),
    /// Nothing was done.
    Refused,
    Unknown,
}

impl Process {
    pub fn new(name: &str, arguments: Vec<String>) -> Process {
        let (running, next) = (Mutex::default(), AtomicU64::new(1));
        Process { name: name.to_owned(), arguments, running, next }
    }

    /// Starts it. When it has caught up, it takes commands.
    pub fn start(&self) {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["nodes::process::node_of_a_log", "--exact", "--ignored", "--nocapture"])
            .env(ARGUMENTS, format!("{} {}", self.name, self.arguments.join(" ")))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        let waiting: Arc<Mutex<HashMap<u64, Sender<String>>>> = Arc::default();
        let (ready, is_ready) = channel();
        waiting.lock().unwrap().insert(0, ready);
        let answers = Arc::clone(&waiting);
        std::thread::spawn(move || {
            for line in output.lines().map_while(Result::ok) {
                // The test program writes lines of its own.
                let Some((id, answer)) = line.split_once(' ') else { continue };
                let Ok(id) = id.parse() else { continue };
                let sender = answers.lock().unwrap().remove(&id);
                // Whoever has asked may have lost patience.
                sender.map(|sender| sender.send(answer.to_owned()));
            }
            answers.lock().unwrap().clear();
        });
        let input = child.stdin.take().unwrap();
        *self.running.lock().unwrap() = Some(Running { child, input, waiting });
        is_ready.recv_timeout(DEADLINE).expect("the node catches up");
    }

    pub fn kill(&self) {
        if let Some(mut running) = self.running.lock().unwrap().take() {
            running.child.kill().unwrap();
            running.child.wait().unwrap();
        }
    }

    pub fn signal(&self, signal: &str) {
        let running = self.running.lock().unwrap();
        signal_to(running.as_ref().unwrap().child.id(), signal);
    }

    pub fn send(&self, command: &str) -> Option<Receiver<String>> {
        let (sender, receiver) = channel();
        let id = self.next.fetch_add(1, Ordering::Relaxed);
        let mut running = self.running.lock().unwrap();
        let running = running.as_mut()?;
        running.waiting.lock().unwrap().insert(id, sender);
        // If the node has died, the answer never comes.
        let _ = writeln!(running.input, "{id} {command}");
        Some(receiver)
    }

    pub fn ask(&self, command: &str, time_limit: Duration) -> Answer {
        match self.send(command) {
            Some(receiver) => Answer::of(&receiver, time_limit),
            None => Answer::Refused,
        }
    }
}

impl Answer {
    /// The answer that comes, if it comes in time.
    pub fn of(receiver: &Receiver<String>, time_limit: Duration) -> Answer {
        let Ok(answer) = receiver.recv_timeout(time_limit) else { return Answer::Unknown };
        match answer.split_once(' ') {
            Some(("ok", value)) => Answer::Ok(value.to_owned()),
            _ if answer == "refused" => Answer::Refused,
            _ => Answer::Unknown,
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The node, in its process: the program of the tests, started again for this one.
///
/// Arguments: the name of the node, the servers (with commas between), the number of replicas, then
/// options. Commands on standard input, one a line, each with a number that its answer repeats:
/// `1 write ADDRESS VALUE`, `2 read ADDRESS`, `3 dump`.
#[test]
#[ignore = "other tests start it"]
fn node_of_a_log() {
    let arguments = std::env::var(ARGUMENTS).expect("another test has started this");
    let mut arguments = arguments.split(' ');
    let mut next = || arguments.next().expect("the name of the node, servers and replicas");
    let (name, servers, replicas) = (next(), next(), next());
    let servers = servers.split(',').map(str::to_owned).collect();
    let mut settings = Settings::new("torture", name, servers);
    settings.replicas = replicas.parse().expect("replicas");
    for option in arguments {
        match option {
            "answers-early" => settings.answers_early = true,
            "refuse" => {
                settings.refuses_when_behind = true;
                settings.max_lag = Duration::from_secs(1);
            }
            "snapshots" => {
                settings.snapshot_steps = 300;
                settings.digest_steps = 500;
            }
            _ => panic!("unknown option {option}"),
        }
    }
    let layout = Layout::default().with(Area::HoldingRegisters, Span::new(0, 65_536).unwrap());
    let memory = Arc::new(Memory::new(layout, None).unwrap());
    let log = Log::new(settings, vec![("plant".to_owned(), Arc::clone(&memory))]).unwrap();
    log.start().unwrap();
    while !log.wait_until_caught_up(Duration::from_millis(100)).unwrap() {}
    // The line that the test program has begun ends here.
    println!();
    answer("0", "ready");
    for line in stdin().lock().lines() {
        let line = line.unwrap();
        let words: Vec<&str> = line.split(' ').collect();
        let number = |at: usize| words[at].parse::<u16>().unwrap();
        match words[1] {
            "write" => write(&memory, words[0].to_owned(), number(2), number(3)),
            "read" => read(&memory, words[0], number(2)),
            "dump" => {
                let mut hasher = DefaultHasher::new();
                Memory::contents(std::slice::from_ref(&memory))[0].areas.hash(&mut hasher);
                answer(words[0], &format!("ok {}", hasher.finish()));
            }
            other => panic!("unknown command {other}"),
        }
        for event in log.take_events(Duration::ZERO) {
            eprintln!("{name} {event:?}");
        }
    }
    log.stop();
}

fn write(memory: &Memory, id: String, address: u16, value: u16) {
    let bytes = value.to_be_bytes();
    let write = Write { area: Area::HoldingRegisters, address, count: 1, bytes: &bytes };
    let answered = id.clone();
    let done = Box::new(move |outcome: Outcome| match outcome {
        Ok(_) => answer(&answered, "ok 0"),
        Err(refused) => refuse(&answered, refused.refusal),
    });
    if let Err(refusal) = memory.submit(Access::Client, Operation::Write(&[write]), done) {
        refuse(&id, refusal);
    }
}

fn read(memory: &Memory, id: &str, address: u16) {
    let mut out = [0; 2];
    let read = Read { area: Area::HoldingRegisters, address, count: 1, out: &mut out };
    match memory.read(Access::Client, read) {
        Ok(()) => answer(id, &format!("ok {}", u16::from_be_bytes(out))),
        Err(refusal) => refuse(id, refusal),
    }
}

fn refuse(id: &str, refusal: Refusal) {
    answer(id, if refusal == Refusal::NotConfirmed { "unknown" } else { "refused" });
}

fn answer(id: &str, text: &str) {
    let mut out = stdout().lock();
    // Whoever asked may be gone.
    let _ = writeln!(out, "{id} {text}").and_then(|()| out.flush());
}
