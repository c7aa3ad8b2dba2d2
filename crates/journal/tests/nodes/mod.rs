//! A real nats-server, and nodes of a log over it.

#![allow(dead_code, reason = "each test uses a part of it")]

pub mod process;

use std::io::{BufRead, BufReader, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use holdfast_journal::log::{Log, LogError, Phase, Settings, Status};
use holdfast_memory::{Access, Area, Layout, Memory, Read, Refusal, Span, Write};

/// How long a test waits for what must happen.
pub const DEADLINE: Duration = Duration::from_secs(60);

pub const REGISTERS: Area = Area::HoldingRegisters;

pub const GATE: Area = Area::Coils;

#[track_caller]
pub fn until(what: &str, mut is: impl FnMut() -> bool) {
    let end = Instant::now() + DEADLINE;
    while !is() {
        assert!(Instant::now() < end, "not within {DEADLINE:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The program, from the environment or from the development environment of the project.
fn program() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let known = std::env::var_os("HOLDFAST_NATS_SERVER").map(PathBuf::from);
    let program = known.unwrap_or_else(|| root.join(".venv/bin/nats-server"));
    assert!(program.exists(), "{} is missing: run `make .venv/dev.stamp`", program.display());
    program
}

/// A folder that is removed at the end.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new() -> Folder {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name =
            format!("holdfast-log-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).unwrap();
        Folder(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A nats-server with JetStream, which can restart with the same port and store.
pub struct Server {
    folder: Folder,
    pub port: u16,
    options: Vec<String>,
    process: Option<Child>,
}

impl Server {
    pub fn new() -> Server {
        Server::with(free_port(), &[])
    }

    pub fn with(port: u16, options: &[String]) -> Server {
        let options = options.to_vec();
        let mut server = Server { folder: Folder::new(), port, options, process: None };
        server.start();
        server
    }

    pub fn url(&self) -> String {
        format!("nats://127.0.0.1:{}", self.port)
    }

    pub fn start(&mut self) {
        let log = self.folder.0.join("log");
        let process = Command::new(program())
            .args(["-a", "127.0.0.1", "-p", &self.port.to_string(), "-js", "-sd"])
            .arg(self.folder.0.join("store"))
            .arg("-l")
            .arg(&log)
            .args(&self.options)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        self.process = Some(process);
        let port = self.port;
        until("nats-server starts", || std::net::TcpStream::connect(("127.0.0.1", port)).is_ok());
    }

    pub fn kill(&mut self) {
        if let Some(mut process) = self.process.take() {
            process.kill().unwrap();
            process.wait().unwrap();
        }
    }

    /// Ends the server, which stores what it knows of its streams before.
    pub fn stop(&mut self) {
        self.signal("TERM");
        if let Some(mut process) = self.process.take() {
            process.wait().unwrap();
        }
    }

    /// Cuts bytes off the end of the messages of a log, while the server is stopped.
    pub fn cut_messages(&self, bytes: u64) {
        assert!(self.process.is_none(), "the server is stopped");
        let stream = "store/jetstream/$G/streams/holdfast-log-site/msgs/1.blk";
        let file = std::fs::File::options().write(true).open(self.folder.0.join(stream)).unwrap();
        file.set_len(file.metadata().unwrap().len() - bytes).unwrap();
    }

    /// Copies what the stopped server has stored, or puts the copy back.
    pub fn copy(&self, from: &str, to: &str) {
        assert!(self.process.is_none(), "the server is stopped");
        let [from, to] = [from, to].map(|name| self.folder.0.join(name));
        let _ = std::fs::remove_dir_all(&to);
        let done = Command::new("cp").arg("-r").args([from, to]).status();
        assert!(done.unwrap().success());
    }

    pub fn signal(&self, signal: &str) {
        let id = self.process.as_ref().unwrap().id();
        signal_to(id, signal);
    }
}

pub fn signal_to(process: u32, signal: &str) {
    let done = Command::new("kill").args([&format!("-{signal}"), &process.to_string()]).status();
    assert!(done.unwrap().success());
    if signal == "STOP" {
        // Its threads run on until the system has stopped them all.
        until("all threads are stopped", || threads_are_stopped(process));
    }
}

/// Always true where the system has no /proc.
fn threads_are_stopped(process: u32) -> bool {
    let Ok(threads) = std::fs::read_dir(format!("/proc/{process}/task")) else { return true };
    threads.flatten().all(|thread| {
        // The state follows the name, which is in parentheses.
        let stat = std::fs::read_to_string(thread.path().join("stat"));
        stat.map_or(true, |stat| stat.rsplit_once(") ").unwrap().1.starts_with('T'))
    })
}

impl Drop for Server {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The URL of a proxy, until the end of the tests: what the server says of itself first is changed there.
pub fn introduced(server: &Server, key: &'static str, value: &serde_json::Value) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("nats://{}", listener.local_addr().unwrap());
    let (port, value) = (server.port, value.clone());
    std::thread::spawn(move || {
        for near in listener.incoming().map(Result::unwrap) {
            let Ok(far) = TcpStream::connect(("127.0.0.1", port)) else { continue };
            let value = value.clone();
            std::thread::spawn(move || introduce(&near, &far, key, value));
        }
    });
    url
}

fn introduce(mut near: &TcpStream, far: &TcpStream, key: &str, value: serde_json::Value) {
    let (mut far, mut line) = (BufReader::new(far), String::new());
    if far.read_line(&mut line).unwrap_or(0) == 0 {
        return;
    }
    let mut info: serde_json::Value = serde_json::from_str(&line["INFO ".len()..]).unwrap();
    info[key] = value;
    let _ = near.write_all(format!("INFO {info}\r\n").as_bytes());
    std::thread::scope(|scope| {
        let server = *far.get_ref();
        scope.spawn(move || {
            pump(near, server);
            let _ = server.shutdown(Shutdown::Write);
        });
        pump(&mut far, near);
        let _ = near.shutdown(Shutdown::Both);
    });
}

/// Passes bytes on, until one of both ends.
fn pump(mut from: impl std::io::Read, mut to: &TcpStream) {
    let mut bytes = [0; 65_536];
    while let Ok(len @ 1..) = from.read(&mut bytes) {
        if to.write_all(&bytes[..len]).is_err() {
            return;
        }
    }
}

/// A cluster of servers. Each knows the routes to all.
pub fn cluster(count: usize) -> Vec<Server> {
    let ports: Vec<u16> = (0..count).map(|_| free_port()).collect();
    let routes: Vec<String> = ports.iter().map(|port| format!("nats://127.0.0.1:{port}")).collect();
    let servers = ports.iter().enumerate().map(|(index, port)| {
        let options = [
            format!("--name=server{index}"),
            "--cluster_name=test".to_owned(),
            format!("--cluster=nats://127.0.0.1:{port}"),
            format!("--routes={}", routes.join(",")),
        ];
        Server::with(free_port(), &options)
    });
    servers.collect()
}

pub fn memory() -> Arc<Memory> {
    memory_of(100)
}

pub fn memory_of(registers: u32) -> Arc<Memory> {
    let span = |size| Span::new(0, size).unwrap();
    let layout = Layout::default().with(REGISTERS, span(registers)).with(Area::Coils, span(64));
    Arc::new(Memory::new(layout, None).unwrap())
}

/// A node with one memory.
pub struct Node {
    pub log: Log,
    pub memory: Arc<Memory>,
}

impl Node {
    pub fn new(servers: &[&Server], name: &str, change: impl FnOnce(&mut Settings)) -> Node {
        Node::with(memory(), servers, name, change)
    }

    pub fn with(
        memory: Arc<Memory>,
        servers: &[&Server],
        name: &str,
        change: impl FnOnce(&mut Settings),
    ) -> Node {
        let urls = servers.iter().map(|server| server.url()).collect();
        let mut settings = Settings::new("site", name, urls);
        settings.write_timeout = Duration::from_secs(10);
        change(&mut settings);
        let memories = vec![("plant".to_owned(), Arc::clone(&memory))];
        Node { log: Log::new(settings, memories).unwrap(), memory }
    }

    pub fn started(servers: &[&Server], name: &str) -> Node {
        let node = Node::new(servers, name, |_| {});
        node.start();
        node
    }

    #[track_caller]
    pub fn start(&self) {
        if let Err(error) = self.try_start() {
            panic!("{error}; {:?}", self.status());
        }
    }

    pub fn try_start(&self) -> Result<(), LogError> {
        self.log.start()?;
        let caught_up = self.log.wait_until_caught_up(DEADLINE)?;
        if caught_up { Ok(()) } else { Err(self.log.startup_timeout_error(DEADLINE)) }
    }

    pub fn status(&self) -> Status {
        self.log.status()
    }

    pub fn write(&self, address: u16, value: u16) -> Result<(), Refusal> {
        let bytes = value.to_be_bytes();
        let write = Write { area: REGISTERS, address, count: 1, bytes: &bytes };
        self.memory.write(Access::Client, write)
    }

    /// Writes, again and again while the log can't be reached.
    #[track_caller]
    pub fn write_at_last(&self, address: u16, value: u16) {
        until("a write is confirmed", || self.write(address, value) == Ok(()));
    }

    pub fn read(&self, address: u16) -> Result<u16, Refusal> {
        let mut out = [0; 2];
        let read = Read { area: REGISTERS, address, count: 1, out: &mut out };
        self.memory.read(Access::Client, read)?;
        Ok(u16::from_be_bytes(out))
    }

    pub fn all(&self) -> Vec<u8> {
        Memory::contents(std::slice::from_ref(&self.memory))[0].areas.concat()
    }

    #[track_caller]
    pub fn until_applied(&self, sequence: u64) {
        until("a sequence is applied", || self.status().sequence >= sequence);
    }

    pub fn failure(&self) -> Option<LogError> {
        match self.status().phase {
            Phase::Failed(error) => Some(error),
            _ => None,
        }
    }
}
