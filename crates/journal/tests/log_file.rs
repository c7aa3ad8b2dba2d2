//! Memories of a log that a file keeps: what a node knows after a restart, and logs that know less.

mod nodes;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use holdfast_journal::file::{
    CheckpointSource, FileError, FileOnDisk, Member, MemoryFile, Options, read,
};
use holdfast_journal::log::{Checkpoint, LogError, LogReader, Settings, Until};
use holdfast_memory::{Contents, Gate, GateMode, Layout, Memory, Refusal, Span};
use nodes::{Folder, Node, Server, memory, memory_of, until};

/// A node, and the file that keeps its memory.
struct KeptNode {
    node: Arc<Node>,
    file: MemoryFile,
}

struct OfNode(Arc<Node>);

impl std::fmt::Debug for OfNode {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_tuple("OfNode").finish_non_exhaustive()
    }
}

impl CheckpointSource for OfNode {
    fn checkpoint(&self) -> Option<Checkpoint> {
        self.0.log.checkpoint()
    }
}

fn opened(path: &Path, memory: &Arc<Memory>) -> Result<MemoryFile, FileError> {
    let member = Member { name: "plant".to_owned(), memory: Arc::clone(memory) };
    let options = Options::new(Duration::from_millis(1));
    MemoryFile::open_of_log(Arc::new(FileOnDisk::new(path)), vec![member], options)
}

impl KeptNode {
    /// Not started yet.
    fn new(server: &Server, path: &Path, change: impl FnOnce(&mut Settings)) -> KeptNode {
        KeptNode::with(memory(), server, path, change)
    }

    fn with(
        memory: Arc<Memory>,
        server: &Server,
        path: &Path,
        change: impl FnOnce(&mut Settings),
    ) -> KeptNode {
        let file = opened(path, &memory).unwrap();
        let node = Node::with(memory, &[server], "a", |settings| {
            settings.memory_file = Some(path.display().to_string());
            change(settings);
        });
        if let Some(note) = file.note() {
            node.log.resume(note).unwrap();
        }
        KeptNode { node: Arc::new(node), file }
    }

    fn started(server: &Server, path: &Path) -> KeptNode {
        let kept = KeptNode::new(server, path, |_| {});
        kept.start();
        kept
    }

    #[track_caller]
    fn start(&self) {
        self.node.start();
        self.file.start(Some(Arc::new(OfNode(Arc::clone(&self.node))))).unwrap();
    }

    fn stop(&self) {
        self.node.log.stop();
        self.file.stop().unwrap();
    }
}

/// The first register in the file.
fn kept_value(path: &Path) -> u16 {
    let kept = read(path).unwrap().remove(0);
    u16::from_be_bytes([kept.areas[2][0], kept.areas[2][1]])
}

fn file_in(folder: &Folder) -> PathBuf {
    folder.0.join("plant.redb")
}

/// The servers lose what was confirmed: 222 in place of 111.
fn lose(server: &mut Server, path: &Path) {
    let node = KeptNode::started(server, path);
    node.node.write(0, 111).unwrap();
    node.stop();
    server.kill();
    server.copy("store", "copy");
    server.start();
    let node = KeptNode::started(server, path);
    for _ in 0..5 {
        node.node.write(0, 222).unwrap();
    }
    node.stop();
    server.kill();
    server.copy("copy", "store");
    server.start();
}

fn says_what_to_do(text: &str, path: &Path) {
    let file = path.display().to_string();
    for part in ["have lost messages", &*file, "holdfast memory export", "Z), but this node"] {
        assert!(text.contains(part), "{part:?} is not in {text}");
    }
}

#[test]
fn a_node_goes_on_where_its_file_ends() {
    let (server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    let other = Node::started(&[&server], "b");
    for value in 1..4 {
        let node = KeptNode::started(&server, &path);
        assert_eq!(node.node.read(0), Ok(value - 1));
        node.node.write(0, value).unwrap();
        node.stop();
        assert_eq!(kept_value(&path), value);
        // What it missed comes from the log.
        other.write(1, value).unwrap();
    }
    let node = KeptNode::started(&server, &path);
    assert_eq!(node.node.all(), other.all());
    assert!(node.file.warnings().is_empty());
}

#[test]
fn what_was_confirmed_is_in_the_file_without_a_stop() {
    let (server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    let node = KeptNode::started(&server, &path);
    node.node.write(0, 7).unwrap();
    until("it is stored", || node.file.status().pending == 0);
    let copy = folder.0.join("copy.redb");
    std::fs::copy(&path, &copy).unwrap();
    assert_eq!(kept_value(&copy), 7);
}

#[test]
fn a_start_with_a_log_that_is_shorter_than_the_file_takes_nothing_from_it() {
    let (mut server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    lose(&mut server, &path);
    let node = KeptNode::new(&server, &path, |_| {});
    node.node.log.start().unwrap();
    until("it says why", || {
        let error = node.node.status().last_error;
        error.is_some_and(|error| error.contains("lost messages"))
    });
    says_what_to_do(&node.node.status().last_error.unwrap(), &path);
    assert_eq!(node.node.write(0, 1), Err(Refusal::Unavailable));
    assert_eq!(node.node.read(0), Ok(222));
    node.stop();
    assert_eq!(kept_value(&path), 222);
    // The log goes on, if that is decided.
    std::fs::rename(&path, folder.0.join("before.redb")).unwrap();
    let node = KeptNode::started(&server, &path);
    assert_eq!(node.node.read(0), Ok(111));
}

#[test]
fn a_start_that_lasts_with_a_shorter_log_fails() {
    let (mut server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    lose(&mut server, &path);
    let node = KeptNode::new(&server, &path, |settings| settings.max_cut_off = Duration::ZERO);
    let error = node.node.try_start().unwrap_err();
    assert_eq!(error.kind(), "replaced");
    says_what_to_do(&error.to_string(), &path);
    node.stop();
    assert_eq!(kept_value(&path), 222);
}

#[test]
fn a_log_that_went_on_elsewhere_is_not_that_of_the_file() {
    let (mut server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    lose(&mut server, &path);
    let other = Node::started(&[&server], "b");
    while other.status().sequence < 100 {
        other.write(1, 1).unwrap();
    }
    let node = KeptNode::new(&server, &path, |_| {});
    let error = node.node.try_start().unwrap_err();
    assert!(error.to_string().contains("is not the one that this node has applied"), "{error}");
    assert!(error.to_string().contains("holdfast memory export"), "{error}");
    node.stop();
    assert_eq!(kept_value(&path), 222);
}

#[test]
fn a_node_that_runs_keeps_what_the_servers_lose() {
    let (mut server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    let node = KeptNode::new(&server, &path, |settings| settings.max_cut_off = Duration::ZERO);
    node.start();
    node.node.write(0, 111).unwrap();
    server.kill();
    server.copy("store", "copy");
    server.start();
    for _ in 0..5 {
        node.node.write_at_last(0, 222);
    }
    server.kill();
    server.copy("copy", "store");
    server.start();
    until("it fails", || node.node.failure().is_some());
    let error = node.node.failure().unwrap();
    assert_eq!(error.kind(), "replaced");
    says_what_to_do(&error.to_string(), &path);
    assert!(node.node.write(0, 1).is_err());
    assert_eq!(node.node.read(0), Err(Refusal::Differs));
    node.stop();
    assert_eq!(kept_value(&path), 222);
    let again = KeptNode::new(&server, &path, |settings| settings.max_cut_off = Duration::ZERO);
    assert_eq!(again.node.try_start().unwrap_err().kind(), "replaced");
}

#[test]
fn a_new_log_under_the_same_name_is_not_that_of_the_file() {
    let folder = Folder::new();
    let path = file_in(&folder);
    let node = KeptNode::started(&Server::new(), &path);
    node.stop();
    let empty = Server::new();
    let node = KeptNode::new(&empty, &path, |settings| settings.max_cut_off = Duration::ZERO);
    let error = node.node.try_start().unwrap_err();
    assert_eq!(error.kind(), "replaced");
    assert!(error.to_string().contains("they have lost it. The contents"), "{error}");
    node.stop();
    Node::started(&[&empty], "b");
    let node = KeptNode::new(&empty, &path, |_| {});
    let error = node.node.try_start().unwrap_err();
    assert!(error.to_string().contains("was deleted and made anew. The contents"), "{error}");
}

#[test]
fn a_file_that_something_else_has_changed_is_refused() {
    let (server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    KeptNode::started(&server, &path).stop();
    for other in [memory_of(99), memory_of(101)] {
        let error = opened(&path, &other).unwrap_err();
        let text = "the file has other areas of memory plant: move the file away";
        assert!(error.to_string().starts_with(text), "{error}");
    }
    // Without the log, the memory is like any other one that is kept.
    let alone = memory();
    let member = Member { name: "plant".to_owned(), memory: Arc::clone(&alone) };
    let disk = Arc::new(FileOnDisk::new(&path));
    let file = MemoryFile::open(disk, vec![member], Options::new(Duration::ZERO)).unwrap();
    assert!(file.note().is_some(), "until it starts, the file is that of the log");
    file.start(None).unwrap();
    file.stop().unwrap();
    let error = opened(&path, &memory()).unwrap_err();
    let text = "the file has contents that are not of a log: export it first";
    assert!(error.to_string().starts_with(text), "{error}");
}

#[test]
fn all_who_ask_at_once_for_what_a_file_keeps_get_it() {
    let (server, folder) = (Server::new(), Folder::new());
    let node = KeptNode::started(&server, &file_in(&folder));
    node.node.write(0, 1).unwrap();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| (0..100).for_each(|_| assert!(node.node.log.checkpoint().is_some())));
        }
    });
}

#[test]
fn a_note_that_does_not_fit_is_refused() {
    let (server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    let node = KeptNode::started(&server, &path);
    node.node.write(0, 1).unwrap();
    let (_, note) = node.node.log.checkpoint().unwrap();
    node.stop();
    let fresh = |log: &str| Node::new(&[&server], "a", |settings| settings.name = log.to_owned());
    let error = fresh("other").log.resume(&note).unwrap_err();
    assert!(
        error.to_string().contains("contents of the log \"site\", not of \"other\""),
        "{error}"
    );
    let error = fresh("site").log.resume(b"{").unwrap_err();
    assert_eq!(error.kind(), "snapshot");
    let error = fresh("site").log.resume(br#"{"version": 3}"#).unwrap_err();
    assert!(matches!(error, LogError::Version { found: 3, .. }), "{error}");
    let other = fresh("site");
    other.log.resume(&note).unwrap();
    let error = other.log.start().unwrap_err();
    assert!(error.to_string().contains("something else has changed the file"), "{error}");
}

#[test]
fn an_open_seal_stays_open_in_a_log_while_another_node_runs() {
    let (server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    let sealed = || {
        let gate = Gate { area: nodes::GATE, address: 3, mode: GateMode::Once };
        let layout = Layout::default()
            .with(nodes::GATE, Span::new(0, 8).unwrap())
            .with(nodes::REGISTERS, Span::new(0, 8).unwrap());
        Arc::new(Memory::new(layout, Some(gate)).unwrap())
    };
    let change = |settings: &mut Settings| settings.answer_timeout = nodes::DEADLINE * 10;
    let kept = || KeptNode::with(sealed(), &server, &path, change);
    let other = Node::with(sealed(), &[&server], "b", change);
    let node = kept();
    node.start();
    other.start();
    let open = holdfast_memory::Write { area: nodes::GATE, address: 3, count: 1, bytes: &[1] };
    node.node.memory.write(holdfast_memory::Access::Ingest, open).unwrap();
    assert!(!node.node.memory.sealed());
    node.stop();
    let before: Vec<Contents> = Memory::contents(std::slice::from_ref(&node.node.memory));
    drop(node);
    let node = kept();
    node.start();
    assert_eq!(Memory::contents(std::slice::from_ref(&node.node.memory)), before);
    node.stop();
    other.log.stop();
    drop(node);
    let node = KeptNode::with(sealed(), &server, &path, |settings| {
        settings.answer_timeout = Duration::from_millis(50);
    });
    node.start();
    assert!(node.node.memory.sealed());
}

/// Whoever may delete messages can shorten the log while a node is away.
#[test]
fn a_node_does_not_go_back_to_a_snapshot_that_the_log_does_not_continue() {
    let (server, folder) = (Server::new(), Folder::new());
    let path = file_in(&folder);
    let other = Node::new(&[&server], "b", |settings| settings.snapshot_steps = 100);
    other.start();
    let kept = KeptNode::started(&server, &path);
    kept.node.write(0, 7).unwrap();
    let contents = kept.node.all();
    kept.stop();
    for value in 0..20 {
        other.write(1, value).unwrap();
    }
    let first = other.status().sequence;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(server.url()).await.unwrap();
        let jetstream = async_nats::jetstream::new(client);
        let stream = jetstream.get_stream("holdfast-log-site").await.unwrap();
        stream.purge().sequence(first).await.unwrap();
    });
    let kept = KeptNode::new(&server, &path, |_| {});
    let new = Node::new(&[&server], "c", |_| {});
    for node in [&*kept.node, &new] {
        node.log.start().unwrap();
        until("the node says why it can't go on", || {
            let error = node.status().last_error.unwrap_or_default();
            error.contains("of the log are missing: only a new snapshot")
        });
    }
    let error = new.status().last_error.unwrap();
    let missing = format!("messages 1 to {} of the log are missing", first - 1);
    assert!(error.starts_with(&missing), "{error}");
    let settings = Settings::new("site", "replay", vec![server.url()]);
    let members = vec![("plant".to_owned(), memory())];
    let mut reader = LogReader::open(&settings, members, Until::Now, nodes::DEADLINE).unwrap();
    assert_eq!(reader.next(nodes::DEADLINE).unwrap_err().to_string(), missing);
    assert_eq!(kept.node.all(), contents, "it keeps its own");
    until("a running node stores a snapshot", || {
        other.write(1, 21).unwrap();
        other.status().snapshot.is_some_and(|sequence| sequence > first)
    });
    for node in [&*kept.node, &new] {
        until("the node goes on", || node.read(1) == Ok(21));
        assert_eq!(node.read(0), Ok(7));
    }
}
