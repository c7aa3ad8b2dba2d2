//! Full disks, I/O errors, and threads that panic.

mod support;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use holdfast_journal::file::{Disk, FileError, FileOnDisk, MemoryFile, Options};
use holdfast_memory::{Access, Memory, Operation, Refusal, Write};
use redb::backends::FileBackend;
use redb::{Builder, Database, StorageBackend};
use support::sim::SimDisk;
use support::{
    REGISTERS, at_once, contents, get, keep, layout, member, memory, set, submit, until,
};

const NOT_STORED: Result<(), Refusal> = Err(Refusal::NotStored);

/// What a restart finds.
fn stored(disk: &SimDisk) -> Arc<Memory> {
    let found = memory(layout(0, 1000), None);
    let disk = Arc::new(SimDisk::with_file(disk.bytes()));
    let file = keep(&disk, &[("one", &found)], at_once()).unwrap();
    file.stop().unwrap();
    found
}

/// Storing again begins with the next step only.
fn patient() -> Options {
    Options { retry: Duration::from_secs(3600), ..at_once() }
}

#[test]
fn an_io_error_refuses_steps_and_changes_nothing() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = keep(&disk, &[("one", &one)], patient()).unwrap();
    set(&one, 0, 1).unwrap();
    let (before, writes) = (contents(&one), one.writes());
    disk.set_broken(true);
    for value in 2..20 {
        assert_eq!(set(&one, 0, value), NOT_STORED);
    }
    assert_eq!(one.mask_write(Access::Client, REGISTERS, 0, 0, 3), NOT_STORED);
    assert_eq!(contents(&one), before);
    assert_eq!(one.writes(), writes);
    let status = file.status();
    assert_eq!((status.failing.as_deref(), status.refused), (Some("the disk is broken"), 19));
    assert_eq!(stored(&disk).writes(), 1);
    disk.set_broken(false);
    set(&one, 1, 7).unwrap();
    assert_eq!(file.status().failing, None);
    file.stop().unwrap();
    assert_eq!((get(&one, 0), get(&one, 1)), (1, 7));
    assert_eq!(contents(&stored(&disk)), contents(&one));
}

#[test]
fn all_steps_of_a_group_that_cannot_be_stored_are_refused() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = keep(&disk, &[("one", &one)], patient()).unwrap();
    disk.hold(true);
    let mut coming = vec![submit(&one, 0, 1)];
    until("the first step", || disk.is_blocking());
    coming.extend((1..50).map(|address| submit(&one, address, 1)));
    disk.set_broken(true);
    disk.hold(false);
    for outcome in coming {
        assert_eq!(outcome.recv().unwrap().unwrap_err().refusal, Refusal::NotStored);
    }
    assert_eq!(file.status().refused, 50);
    disk.set_broken(false);
    assert!(contents(&one).areas[2].iter().all(|byte| *byte == 0));
    set(&one, 60, 1).unwrap();
    assert_eq!(contents(&stored(&disk)), contents(&one));
}

#[test]
fn storing_recovers_without_a_step() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let options = Options { retry: Duration::from_millis(1), ..at_once() };
    let file = keep(&disk, &[("one", &one)], options).unwrap();
    disk.set_broken(true);
    assert_eq!(set(&one, 0, 2), NOT_STORED);
    disk.set_broken(false);
    until("recovery", || file.status().failing.is_none());
    assert_eq!(get(&stored(&disk), 0), 0);
}

#[test]
fn a_full_disk_refuses_steps_until_there_is_room() {
    let disk = Arc::new(SimDisk::default());
    let memories: Vec<_> = (0..40).map(|_| memory(layout(0, 65_536), None)).collect();
    let names: Vec<_> = (0..40).map(|number| number.to_string()).collect();
    let named: Vec<_> = names.iter().map(|name| &**name).zip(&memories).collect();
    let file = keep(&disk, &named, patient()).unwrap();
    let size = file.status().bytes;
    disk.set_capacity(Some(size));
    let all = |memory: &Memory, value: u8| {
        let bytes = [value; 65_536 * 2];
        memory.write(
            Access::Ingest,
            Write { area: REGISTERS, address: 0, count: 65_536, bytes: &bytes },
        )
    };
    let mut results = (1..=3).flat_map(|value| memories.iter().map(move |one| (one, value)));
    let full = results.find_map(|(one, value)| all(one, value).err().map(|refusal| (one, refusal)));
    // Free pages may be enough for everything.
    if let Some((one, refusal)) = full {
        assert_eq!(refusal, Refusal::NotStored);
        assert!(file.status().failing.is_some());
        disk.set_capacity(None);
        all(one, 9).unwrap();
    }
    assert_eq!(file.status().failing, None);
    disk.set_capacity(Some(1 << 16));
    disk.set_broken(true);
    assert_eq!(set(&memories[0], 0, 77), NOT_STORED);
    disk.set_broken(false);
    assert_eq!(set(&memories[0], 0, 77), NOT_STORED);
    assert_eq!(file.status().failing.as_deref(), Some("no storage space"));
    disk.set_capacity(None);
    set(&memories[0], 0, 77).unwrap();
    file.stop().unwrap();
    let found: Vec<_> = (0..40).map(|_| memory(layout(0, 65_536), None)).collect();
    let named: Vec<_> = names.iter().map(|name| &**name).zip(&found).collect();
    let file = keep(&disk, &named, at_once()).unwrap();
    assert_eq!(file.loaded().len(), 40);
    assert_eq!(Memory::contents(&found), Memory::contents(&memories));
}

/// A real file that fails until another takes its place.
#[derive(Debug)]
struct Failing {
    disk: FileOnDisk,
    path: PathBuf,
    fails: Arc<AtomicBool>,
}

#[derive(Debug)]
struct FailingBackend {
    file: FileBackend,
    fails: Arc<AtomicBool>,
}

impl StorageBackend for FailingBackend {
    fn len(&self) -> io::Result<u64> {
        self.file.len()
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.file.read(offset, out)
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.file.set_len(len)
    }

    fn sync_data(&self) -> io::Result<()> {
        if self.fails.load(Ordering::SeqCst) {
            return Err(io::Error::other("no sync"));
        }
        self.file.sync_data()
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.file.write(offset, data)
    }
}

impl Disk for Failing {
    fn size(&self) -> Result<Option<u64>, FileError> {
        self.disk.size()
    }

    fn open(&self, builder: &Builder) -> Result<Database, FileError> {
        drop(self.disk.open(builder)?);
        let file = std::fs::File::options().read(true).write(true).open(&self.path)?;
        let (file, fails) = (FileBackend::new(file)?, Arc::clone(&self.fails));
        Ok(builder.create_with_backend(FailingBackend { file, fails })?)
    }

    fn open_unchanged(&self, builder: &Builder) -> Result<Database, FileError> {
        self.disk.open_unchanged(builder)
    }

    fn create(&self, builder: &Builder) -> Result<Database, FileError> {
        self.disk.create(builder)
    }

    fn is_in_place(&self) -> Result<bool, FileError> {
        self.disk.is_in_place()
    }

    fn install(&self) -> Result<(), FileError> {
        self.disk.install()
    }

    fn discard(&self) {
        self.disk.discard();
    }
}

#[test]
fn a_real_file_is_replaced_after_an_error_and_stays_locked() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("replaced");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("memories.redb");
    let other = || Arc::new(FileOnDisk::new(&path));
    let one = memory(layout(0, 1000), None);
    keep(&other(), &[("one", &one)], patient()).unwrap().stop().unwrap();

    let (disk, fails) = (FileOnDisk::new(&path), Arc::new(AtomicBool::new(false)));
    let failing = Failing { disk, path: path.clone(), fails: Arc::clone(&fails) };
    let one = memory(layout(0, 1000), None);
    let file = keep(&Arc::new(failing), &[("one", &one)], patient()).unwrap();
    set(&one, 0, 1).unwrap();
    fails.store(true, Ordering::SeqCst);
    assert_eq!(set(&one, 0, 2), NOT_STORED);
    assert_eq!(file.status().failing.as_deref(), Some("no sync"));
    set(&one, 1, 3).unwrap();
    assert_eq!(file.status().failing, None);
    let two = memory(layout(0, 1000), None);
    let locked = keep(&other(), &[("one", &two)], patient()).unwrap_err();
    assert!(matches!(locked, FileError::Locked), "{locked}");
    file.stop().unwrap();
    keep(&other(), &[("one", &two)], patient()).unwrap();
    assert_eq!(contents(&two), contents(&one));
    assert_eq!((get(&two, 0), get(&two, 1)), (1, 3));
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
}

#[test]
fn with_a_time_a_memory_goes_on_and_is_stored_when_the_disk_is_back() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = keep(&disk, &[("one", &one)], Options::new(Duration::from_millis(1))).unwrap();
    disk.set_broken(true);
    set(&one, 0, 5).unwrap();
    until("the error", || file.status().failing.is_some());
    set(&one, 1, 6).unwrap();
    assert!(file.status().pending > 0);
    disk.set_broken(false);
    until("recovery", || file.status().failing.is_none() && file.status().pending == 0);
    assert_eq!(contents(&stored(&disk)), contents(&one));
    disk.set_broken(true);
    set(&one, 2, 7).unwrap();
    assert_eq!(file.stop().unwrap_err().to_string(), "the disk is broken");
    file.stop().unwrap();
}

#[test]
fn a_stop_says_that_the_file_is_in_doubt() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = keep(&disk, &[("one", &one)], patient()).unwrap();
    disk.set_broken(true);
    assert_eq!(set(&one, 0, 5), NOT_STORED);
    assert_eq!(file.stop().unwrap_err().to_string(), "the disk is broken");
}

#[test]
fn a_start_that_cannot_store_is_an_error_and_can_be_repeated() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let members = vec![member("one", &one)];
    let file = MemoryFile::open(Arc::clone(&disk) as _, members, at_once()).unwrap();
    disk.set_broken(true);
    file.start(None).unwrap_err();
    disk.set_broken(false);
    set(&one, 0, 5).unwrap();
    file.start(None).unwrap();
    assert_eq!(contents(&stored(&disk)), contents(&one));
}

#[test]
fn a_thread_that_panics_leaves_nobody_waiting() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    disk.hold(true);
    let first = submit(&one, 0, 1);
    until("the first step", || disk.is_blocking());
    let bytes = [0, 1];
    let write = Write { area: REGISTERS, address: 1, count: 1, bytes: &bytes };
    let panicking = Box::new(|_| panic!("a receiver that panics"));
    one.submit(Access::Ingest, Operation::Write(&[write]), panicking).unwrap();
    let behind = submit(&one, 2, 1);
    disk.hold(false);
    first.recv().unwrap().unwrap();
    // It was stored, but nobody can say so: its receiver is dropped.
    behind.recv().unwrap_err();
    until("the end", || set(&one, 3, 1) == Err(Refusal::Unavailable));
    assert!(file.status().failing.unwrap().contains("panicked"));
    file.stop().unwrap_err();
}

#[test]
fn a_disk_that_does_not_answer_is_an_error_until_it_does() {
    for sync in [0, 1].map(Duration::from_millis) {
        let disk = Arc::new(SimDisk::default());
        let one = memory(layout(0, 1000), None);
        let options = Options { patience: Duration::from_millis(1), ..Options::new(sync) };
        let file = keep(&disk, &[("one", &one)], options).unwrap();
        disk.hold(true);
        let writing = std::thread::spawn({
            let one = Arc::clone(&one);
            move || set(&one, 0, 7)
        });
        let expected = Some("the disk has not answered for 0.001 s");
        until("the error", || {
            let status = file.status();
            status.failing.as_deref() == expected && status.pending == 1
        });
        disk.hold(false);
        writing.join().unwrap().unwrap();
        until("recovery", || file.status().failing.is_none() && file.status().pending == 0);
        assert_eq!(get(&stored(&disk), 0), 7);
    }
}

/// A file that is kept in a folder of its own, with 1 at address 0.
#[cfg(unix)]
fn kept(name: &str, options: Options) -> (PathBuf, Arc<Memory>, MemoryFile) {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("memories.redb");
    let one = memory(layout(0, 1000), None);
    let file = keep(&Arc::new(FileOnDisk::new(&path)), &[("one", &one)], options).unwrap();
    set(&one, 0, 1).unwrap();
    (path, one, file)
}

/// What a start finds, after a kill at this moment.
#[cfg(unix)]
fn after_a_kill(path: &Path) -> (u16, u16) {
    let copy = path.with_extension("copy");
    std::fs::copy(path, &copy).unwrap();
    let found = memory(layout(0, 1000), None);
    keep(&Arc::new(FileOnDisk::new(&copy)), &[("one", &found)], patient()).unwrap();
    std::fs::remove_file(copy).unwrap();
    (get(&found, 0), get(&found, 1))
}

#[cfg(unix)]
#[test]
fn a_file_that_is_removed_is_written_anew_before_a_write_is_confirmed() {
    let (path, one, file) = kept("removed", patient());
    std::fs::remove_file(&path).unwrap();
    set(&one, 1, 2).unwrap();
    assert_eq!(after_a_kill(&path), (1, 2));
    std::fs::rename(&path, path.with_extension("moved")).unwrap();
    set(&one, 1, 3).unwrap();
    assert_eq!(after_a_kill(&path), (1, 3));
    assert_eq!(after_a_kill(&path.with_extension("moved")), (1, 2));
    assert_eq!(file.status().recreated, 2);
    std::fs::remove_file(&path).unwrap();
    file.stop().unwrap();
    assert_eq!(after_a_kill(&path), (1, 3));
}

#[cfg(unix)]
#[test]
fn a_file_that_is_removed_is_written_anew_without_a_write() {
    let soon = Duration::from_millis(1);
    let options = [Options { retry: soon, ..at_once() }, Options::new(soon)];
    for (name, options) in ["removed at 0", "removed at 1"].into_iter().zip(options) {
        let (path, _one, file) = kept(name, options);
        until("it is stored", || file.status().pending == 0);
        std::fs::remove_file(&path).unwrap();
        until("a new file", || file.status().recreated == 1);
        assert_eq!(after_a_kill(&path), (1, 0));
        assert_eq!(file.status().failing, None);
    }
}

#[cfg(unix)]
#[test]
fn another_file_is_never_replaced() {
    let (path, one, file) = kept("another", patient());
    let (own, other) = (path.with_extension("own"), path.with_extension("other"));
    std::fs::rename(&path, &own).unwrap();
    std::fs::write(&path, "other").unwrap();
    assert_eq!(set(&one, 1, 2), NOT_STORED);
    assert!(file.status().failing.unwrap().starts_with("another file is in its place."));
    // The own one is back: it has everything.
    std::fs::rename(&path, &other).unwrap();
    std::fs::rename(&own, &path).unwrap();
    set(&one, 1, 3).unwrap();
    assert_eq!((file.status().failing, file.status().recreated), (None, 0));
    std::fs::rename(&other, &path).unwrap();
    assert_eq!(set(&one, 1, 4), NOT_STORED);
    assert_eq!(std::fs::read(&path).unwrap(), b"other");
    std::fs::remove_file(&path).unwrap();
    set(&one, 0, 5).unwrap();
    assert_eq!(after_a_kill(&path), (5, 3));
    std::fs::write(&own, "other").unwrap();
    std::fs::rename(&own, &path).unwrap();
    assert!(matches!(file.stop(), Err(FileError::Replaced)));
    assert!(file.status().pending > 0, "nothing of it is on the disk");
    assert_eq!(std::fs::read(&path).unwrap(), b"other");
    assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
}

#[cfg(unix)]
#[test]
fn what_is_no_file_is_never_replaced_and_nothing_is_stored_there() {
    let put: [fn(&Path); 2] = [
        |path| std::fs::create_dir(path).unwrap(),
        |path| std::os::unix::fs::symlink("nothing", path).unwrap(),
    ];
    for put in put {
        let (path, one, file) = kept("no file", patient());
        std::fs::remove_file(&path).unwrap();
        put(&path);
        assert_eq!(set(&one, 1, 2), NOT_STORED);
        assert!(matches!(file.stop(), Err(FileError::Foreign(_))));
        assert_eq!(file.status().pending, 1, "nothing of it is on the disk");
    }
}

/// An unmounted file system leaves the empty folder of its mount point. Here a link leads to one.
#[cfg(target_os = "linux")]
#[test]
fn a_file_system_that_is_gone_refuses_steps_until_it_is_back() {
    use std::os::unix::fs::{MetadataExt, symlink};
    let mounted = Path::new("/dev/shm").join(format!("holdfast-{}", std::process::id()));
    let (path, _, file) = kept("mounted", patient());
    file.stop().unwrap();
    let empty = path.parent().unwrap();
    std::fs::remove_file(&path).unwrap();
    let _ = std::fs::remove_dir_all(&mounted);
    std::fs::create_dir(&mounted).unwrap();
    let device = |path: &Path| std::fs::metadata(path).unwrap().dev();
    assert_ne!(device(&mounted), device(empty), "the test needs two file systems");
    let link = empty.with_extension("link");
    let lead_to = |folder: &Path| {
        let _ = std::fs::remove_file(&link);
        symlink(folder, &link).unwrap();
    };
    lead_to(&mounted);
    let (path, one) = (link.join("memories.redb"), memory(layout(0, 1000), None));
    let file = keep(&Arc::new(FileOnDisk::new(&path)), &[("one", &one)], patient()).unwrap();
    set(&one, 0, 1).unwrap();
    lead_to(empty);
    assert_eq!(set(&one, 1, 2), NOT_STORED);
    assert!(file.status().failing.unwrap().starts_with("its folder is gone, or on another file"));
    assert_eq!(std::fs::read_dir(empty).unwrap().count(), 0);
    lead_to(&mounted);
    set(&one, 1, 3).unwrap();
    assert_eq!(after_a_kill(&path), (1, 3));
    assert_eq!((file.status().failing, file.status().recreated), (None, 0));
    lead_to(empty);
    assert!(matches!(file.stop(), Err(FileError::FolderGone { was_removed: false })));
    assert_eq!(file.status().pending, 0, "it is all on the other file system");
    assert_eq!(std::fs::read_dir(empty).unwrap().count(), 0);
    std::fs::remove_dir_all(&mounted).unwrap();
}

#[cfg(unix)]
#[test]
fn a_folder_that_is_gone_refuses_steps_until_it_is_back() {
    let (path, one, file) = kept("folder", patient());
    let (folder, moved) = (path.parent().unwrap(), path.parent().unwrap().with_extension("moved"));
    let _ = std::fs::remove_dir_all(&moved);
    std::fs::rename(folder, &moved).unwrap();
    assert_eq!(set(&one, 1, 2), NOT_STORED);
    assert!(file.status().failing.is_some());
    std::fs::rename(&moved, folder).unwrap();
    set(&one, 1, 3).unwrap();
    assert_eq!(after_a_kill(&path), (1, 3));
    assert_eq!(file.status().failing, None);
}

/// How many writes are missing after a stop, if this is done to the folder of the file, and then one more write
/// comes. Before it, there were two writes, or none but one of an earlier start.
#[cfg(unix)]
fn not_found(sync: Duration, is_loaded: bool, spoil: impl Fn(&Path, &Path)) -> u64 {
    let options = || Options { retry: Duration::from_secs(3600), ..Options::new(sync) };
    let (path, mut one, mut file) = kept("spoiled", options());
    if is_loaded {
        file.stop().unwrap();
        one = memory(layout(0, 1000), None);
        file = keep(&Arc::new(FileOnDisk::new(&path)), &[("one", &one)], options()).unwrap();
        assert_eq!(get(&one, 0), 1);
    } else {
        set(&one, 1, 2).unwrap();
        until("it is stored", || file.status().pending == 0);
    }
    let moved = path.parent().unwrap().with_extension("moved");
    let _ = std::fs::remove_dir_all(&moved);
    spoil(path.parent().unwrap(), &moved);
    let _ = set(&one, 2, 3);
    file.stop().unwrap_err();
    file.status().pending
}

#[cfg(unix)]
#[test]
fn what_a_file_has_that_was_moved_with_its_folder_is_not_missing() {
    let moving = |folder: &Path, moved: &Path| std::fs::rename(folder, moved).unwrap();
    for is_loaded in [false, true] {
        assert_eq!(not_found(Duration::ZERO, is_loaded, moving), 0, "the last write was refused");
        let unstored = not_found(Duration::from_millis(50), is_loaded, moving);
        assert_eq!(unstored, 1, "the last write was confirmed");
    }
}

#[cfg(unix)]
#[test]
fn what_was_stored_in_a_file_that_is_away_is_missing() {
    // Moved first, so that nothing writes the file anew while its folder is removed.
    let remove = |folder: &Path, moved: &Path| {
        std::fs::rename(folder, moved).unwrap();
        std::fs::remove_dir_all(moved).unwrap();
    };
    let replace = |folder: &Path, moved: &Path| {
        std::fs::write(moved, "other").unwrap();
        std::fs::rename(moved, folder.join("memories.redb")).unwrap();
    };
    let spoiling: [fn(&Path, &Path); 2] = [remove, replace];
    for spoil in spoiling {
        assert_eq!(not_found(Duration::ZERO, false, spoil), 2);
        assert_eq!(not_found(Duration::from_secs(1), false, spoil), 3);
        assert_eq!(not_found(Duration::ZERO, true, spoil), 1, "what was loaded is away too");
        assert_eq!(not_found(Duration::from_secs(1), true, spoil), 1);
    }
}
