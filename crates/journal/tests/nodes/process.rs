//! A node of a log in a process of its own, which a test can kill and stop.

use std::collections::HashMap;
use std::io::{BufRead, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::{DEADLINE, signal_to};

fn program() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let folder = tests.parent().and_then(Path::parent).unwrap();
    let program = folder.join("examples/log_node");
    assert!(program.exists(), "{} is missing: run `cargo build --examples`", program.display());
    program
}

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
        let mut child = Command::new(program())
            .arg(&self.name)
            .args(&self.arguments)
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
                let (id, answer) = line.split_once(' ').unwrap();
                let sender = answers.lock().unwrap().remove(&id.parse().unwrap());
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

    pub fn ask(&self, command: &str, patience: Duration) -> Answer {
        match self.send(command) {
            Some(receiver) => Answer::of(&receiver, patience),
            None => Answer::Refused,
        }
    }
}

impl Answer {
    /// The answer that comes, if it comes in time.
    pub fn of(receiver: &Receiver<String>, patience: Duration) -> Answer {
        let Ok(answer) = receiver.recv_timeout(patience) else { return Answer::Unknown };
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
