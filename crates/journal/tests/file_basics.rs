//! Storing, loading, and what becomes of steps.

mod support;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_journal::file::{
    Disk, FileError, FileOnDisk, MemoryFile, Options, QueueLimits, Status, read_from, release,
};
use holdfast_memory::{
    Access, Area, Freshness, Gate, GateMode, Layout, Memory, Mirrored, Read, Refusal, Span, Write,
    write_across,
};
use redb::{Database, ReadableDatabase, TableDefinition};
use support::sim::SimDisk;
use support::{
    REGISTERS, at_once, contents, get, keep, layout, member, memory, set, submit, until,
};

const REFUSED: Result<(), Refusal> = Err(Refusal::Unavailable);

fn folder(name: &str) -> std::path::PathBuf {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

#[test]
fn contents_survive_a_restart() {
    for sync in [Duration::ZERO, Duration::from_secs(3600)] {
        let path = folder(&format!("restart{}", sync.as_secs())).join("memories.redb");
        let disk = Arc::new(FileOnDisk::new(&path));
        let layout = layout(9, 1000);
        let (one, two) = (memory(layout.clone(), None), memory(layout.clone(), None));
        let file = keep(&disk, &[("one", &one), ("two", &two)], Options::new(sync)).unwrap();
        assert!(file.loaded().is_empty());
        set(&one, 999, 7).unwrap();
        set(&two, 128, 0xfffe).unwrap();
        let coils = Write { area: Area::Coils, address: 7, count: 2, bytes: &[3] };
        one.write(Access::Client, coils).unwrap();
        assert_eq!(one.has_journal(), sync.is_zero());
        file.stop().unwrap();
        file.stop().unwrap();
        let stored = [contents(&one), contents(&two)];
        if sync.is_zero() {
            assert_eq!(set(&one, 0, 1), REFUSED);
            assert_eq!(get(&one, 0), 0);
        }
        let (one, two) = (memory(layout.clone(), None), memory(layout.clone(), None));
        let members = vec![member("one", &one), member("two", &two)];
        let file = MemoryFile::open(disk, members, Options::new(sync)).unwrap();
        assert_eq!(file.loaded(), ["one", "two"]);
        assert!(file.warnings().is_empty());
        assert_eq!([contents(&one), contents(&two)], stored);
        let names: Vec<_> = std::fs::read_dir(path.parent().unwrap()).unwrap().collect();
        assert_eq!(names.len(), 1, "{names:?}");
    }
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

#[test]
fn values_of_a_device_have_no_age_after_a_restart() {
    let path = folder("ages").join("memories.redb");
    let disk = Arc::new(FileOnDisk::new(&path));
    let watched = || {
        let (one, ages) = (memory(layout(0, 10), None), Arc::new(Ages::default()));
        let freshness = Some(Arc::clone(&ages) as Arc<dyn Freshness>);
        one.mirror(vec![Mirrored { freshness, ..Mirrored::reserved(REGISTERS, 3, 1) }]).unwrap();
        (one, ages)
    };
    let (one, ages) = watched();
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    let write = Write { area: REGISTERS, address: 3, count: 1, bytes: &[0, 7] };
    one.write(Access::Mirror, write).unwrap();
    assert_eq!(ages.0.lock().unwrap()[..], [Duration::ZERO]);
    file.stop().unwrap();
    let (one, ages) = watched();
    keep(&disk, &[("one", &one)], at_once()).unwrap();
    assert_eq!(get(&one, 3), 7);
    assert!(ages.0.lock().unwrap().is_empty());
}

#[test]
fn of_two_that_create_the_file_at_once_one_has_it() {
    let path = folder("at_once").join("memories.redb");
    let builder = redb::Database::builder();
    // In two containers, both processes have the same number.
    let [first, second] = [(); 2].map(|()| FileOnDisk::new(&path));
    let database = first.create(&builder).unwrap();
    let late = second.create(&builder).unwrap();
    first.install().unwrap();
    assert!(matches!(second.install(), Err(FileError::Locked)));
    drop(late);
    // What is there is in use: it is what the first one created.
    assert!(matches!(second.open(&builder), Err(FileError::Locked)));
    drop(database);
}

#[test]
fn what_killed_processes_left_is_removed() {
    let folder = folder("left");
    let path = folder.join("memories.redb");
    let names =
        ["memories.redb.77.new", "memories.redb.x.new", "memories.redb.new", "other.77.new"];
    for _ in 0..2 {
        for name in names {
            std::fs::write(folder.join(name), "half").unwrap();
        }
        let one = memory(layout(0, 10), None);
        keep(&Arc::new(FileOnDisk::new(&path)), &[("one", &one)], at_once()).unwrap();
    }
    let left = names.map(|name| folder.join(name).exists());
    assert_eq!(left, [false, true, true, true]);
}

#[test]
fn a_file_that_takes_the_place_of_another_has_its_permissions() {
    let path = folder("permissions").join("memories.redb");
    let disk = Arc::new(FileOnDisk::new(&path));
    let one = memory(layout(0, 10), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    let mut permissions = std::fs::metadata(&path).unwrap().permissions();
    private(&mut permissions);
    std::fs::set_permissions(&path, permissions).unwrap();
    let permissions = std::fs::metadata(&path).unwrap().permissions();
    disk.create(&redb::Database::builder()).unwrap().close().unwrap();
    disk.install().unwrap();
    assert_eq!(std::fs::metadata(&path).unwrap().permissions(), permissions);
    file.stop().unwrap();
}

#[cfg(unix)]
fn private(permissions: &mut std::fs::Permissions) {
    std::os::unix::fs::PermissionsExt::set_mode(permissions, 0o600);
}

#[cfg(not(unix))]
fn private(_: &mut std::fs::Permissions) {}

#[test]
fn what_is_written_before_the_start_is_stored_by_it() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 10), None);
    let file = MemoryFile::open(Arc::clone(&disk) as _, vec![member("one", &one)], at_once());
    let file = file.unwrap();
    set(&one, 3, 33).unwrap();
    assert_eq!(file.status().commits, 0);
    file.start(None).unwrap();
    assert_eq!(file.status().commits, 1);
    let two = memory(layout(0, 10), None);
    let disk = Arc::new(SimDisk::with_file(disk.bytes()));
    keep(&disk, &[("one", &two)], at_once()).unwrap();
    assert_eq!(get(&two, 3), 33);
}

#[test]
fn a_process_that_ends_before_the_start_leaves_no_contents() {
    let disk = Arc::new(SimDisk::default());
    for _ in 0..2 {
        let one = memory(layout(0, 10), None);
        let members = vec![member("one", &one)];
        let file = MemoryFile::open(Arc::clone(&disk) as _, members, at_once()).unwrap();
        assert!(file.loaded().is_empty());
    }
}

#[test]
fn a_write_that_changes_nothing_is_not_stored() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 10), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    set(&one, 3, 33).unwrap();
    let (commits, syncs) = (file.status().commits, disk.syncs());
    for _ in 0..100 {
        set(&one, 3, 33).unwrap();
    }
    assert_eq!((file.status().commits, disk.syncs()), (commits, syncs));
    set(&one, 3, 34).unwrap();
    assert_eq!(file.status().commits, commits + 1);
}

#[test]
fn steps_that_wait_are_stored_together() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    let commits = file.status().commits;
    disk.hold(true);
    let mut coming = vec![submit(&one, 0, 1)];
    until("the first step", || disk.is_blocking());
    coming.extend((1..500).map(|address| submit(&one, address, 1)));
    assert_eq!(file.status().pending, 500);
    assert_eq!(get(&one, 0), 0, "nothing changes before it is stored");
    disk.hold(false);
    for outcome in coming {
        outcome.recv().unwrap().unwrap();
    }
    assert_eq!(file.status().commits, commits + 2);
}

#[test]
fn the_queue_is_bounded_in_steps_and_bytes() {
    for (steps, bytes) in [(10, usize::MAX), (usize::MAX, 4000)] {
        let disk = Arc::new(SimDisk::default());
        let one = memory(layout(0, 1000), None);
        let options = Options { queue: QueueLimits { steps, bytes }, ..at_once() };
        let file = keep(&disk, &[("one", &one)], options).unwrap();
        disk.hold(true);
        let mut coming = vec![submit(&one, 0, 1)];
        until("the first step", || disk.is_blocking());
        coming.extend((1..1000).map(|address| submit(&one, address, 1)));
        let full = coming.iter().position(|outcome| outcome.try_recv().is_ok()).unwrap();
        assert!((2..=60).contains(&full), "{full}");
        disk.hold(false);
        for (address, outcome) in (0..).zip(&coming) {
            // One refusal was received above.
            if usize::from(address) != full {
                let refusal = outcome.recv().unwrap().err().map(|refused| refused.refusal);
                assert_eq!(refusal, (usize::from(address) > full).then_some(Refusal::Busy));
            }
            assert_eq!(get(&one, address), u16::from(usize::from(address) < full));
        }
        let Status { busy, refused, failing, .. } = file.status();
        assert_eq!((busy, refused, failing), (1000 - full as u64, 0, None));
        set(&one, 999, 1).unwrap();
    }
}

#[test]
fn a_step_of_any_size_is_stored_when_no_other_waits() {
    let one = memory(layout(0, 1000), None);
    let options = Options { queue: QueueLimits { steps: usize::MAX, bytes: 1000 }, ..at_once() };
    let _file = keep(&Arc::new(SimDisk::default()), &[("one", &one)], options).unwrap();
    let write = Write { area: REGISTERS, address: 0, count: 1000, bytes: &[1; 2000] };
    one.write(Access::Ingest, write).unwrap();
    assert_eq!(get(&one, 999), 0x0101);
}

#[test]
fn stopping_answers_what_waits() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 1000), None);
    let file = Arc::new(keep(&disk, &[("one", &one)], at_once()).unwrap());
    disk.hold(true);
    let mut coming = vec![submit(&one, 0, 1)];
    until("the first step", || disk.is_blocking());
    coming.extend((1..10).map(|address| submit(&one, address, 1)));
    let stopping = std::thread::spawn({
        let file = Arc::clone(&file);
        move || file.stop()
    });
    until("stop", || submit(&one, 0, 1).try_recv().is_ok_and(|outcome| outcome.is_err()));
    disk.hold(false);
    stopping.join().unwrap().unwrap();
    for outcome in coming {
        outcome.recv().unwrap().unwrap();
    }
    assert_eq!(set(&one, 20, 1), REFUSED);
    let two = memory(layout(0, 1000), None);
    keep(&Arc::new(SimDisk::with_file(disk.bytes())), &[("one", &two)], at_once()).unwrap();
    assert_eq!(contents(&two), contents(&one));
}

#[test]
fn refused_steps_are_not_stored_and_change_nothing() {
    let disk = Arc::new(SimDisk::default());
    let gate = Gate { area: Area::Coils, address: 0, mode: GateMode::Level };
    let one = memory(layout(8, 10), Some(gate));
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    let commits = file.status().commits;
    let write = Write { area: REGISTERS, address: 0, count: 1, bytes: &[1, 1] };
    assert_eq!(one.write(Access::Client, write), Err(Refusal::Sealed));
    let outside = Write { address: 10, ..write };
    assert_eq!(one.write(Access::Ingest, outside), Err(Refusal::OutOfRange));
    assert_eq!(file.status().commits, commits);
    assert_eq!(file.status().refused, 0);
}

#[test]
fn a_batch_across_memories_is_one_transaction() {
    let disk = Arc::new(SimDisk::default());
    let (one, two) = (memory(layout(0, 10), None), memory(layout(0, 10), None));
    let file = keep(&disk, &[("one", &one), ("two", &two)], at_once()).unwrap();
    let commits = file.status().commits;
    let write = Write { area: REGISTERS, address: 4, count: 1, bytes: &[1, 1] };
    write_across(Access::Ingest, &[(&one, write), (&two, write)]).unwrap();
    assert_eq!(file.status().commits, commits + 1);
    assert_eq!((get(&one, 4), get(&two, 4)), (0x101, 0x101));
    let other = memory(layout(0, 10), None);
    let refused = write_across(Access::Ingest, &[(&one, write), (&other, write)]);
    assert_eq!(refused.unwrap_err().refusal, Refusal::NotOneStep);
}

#[test]
fn a_seal_is_closed_again_by_a_restart() {
    for mode in [GateMode::Once, GateMode::Level] {
        let disk = Arc::new(SimDisk::default());
        let gate = Gate { area: Area::Coils, address: 9, mode };
        let one = memory(layout(20, 10), Some(gate));
        let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
        set(&one, 0, 5).unwrap();
        let open = Write { area: Area::Coils, address: 8, count: 3, bytes: &[7] };
        one.write(Access::Ingest, open).unwrap();
        assert!(!one.sealed());
        file.stop().unwrap();
        for _ in 0..2 {
            let again = memory(layout(20, 10), Some(gate));
            let file = keep(&disk, &[("one", &again)], at_once()).unwrap();
            assert_eq!(again.sealed(), mode == GateMode::Once);
            assert_eq!(get(&again, 0), 5);
            let bits = contents(&again).areas[0][1];
            assert_eq!(bits, if mode == GateMode::Once { 0b101 } else { 0b111 });
            set(&again, 1, 6).unwrap();
            assert_eq!(again.sealed(), mode == GateMode::Once, "an ingest alone opens nothing");
            file.stop().unwrap();
        }
    }
}

#[test]
fn a_resized_area_keeps_the_addresses_of_both() {
    let disk = Arc::new(SimDisk::default());
    let span = |start, size| Span::new(start, size).unwrap();
    let before = Layout::default()
        .with(REGISTERS, span(100, 50))
        .with(Area::Coils, span(3, 40))
        .with(Area::InputRegisters, span(0, 4));
    let one = memory(before, None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    for address in 100..150 {
        set(&one, address, address).unwrap();
    }
    let coils = Write { area: Area::Coils, address: 12, count: 3, bytes: &[0b101] };
    one.write(Access::Ingest, coils).unwrap();
    file.stop().unwrap();
    let after = Layout::default()
        .with(REGISTERS, span(120, 1000))
        .with(Area::Coils, span(10, 5))
        .with(Area::DiscreteInputs, span(0, 8));
    for round in 0..2 {
        let one = memory(after.clone(), None);
        let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
        for address in 120..1120 {
            assert_eq!(get(&one, address), if address < 150 { address } else { 0 });
        }
        assert_eq!(*contents(&one).areas[0], [0b10100]);
        let expected = [
            "one: coils had addresses 3-42 and now has addresses 10-14: addresses 10-14 are kept, \
             addresses 3-9 and 15-42 are set aside",
            "one: discrete_inputs had no addresses and now has addresses 0-7: no address is kept",
            "one: holding_registers had addresses 100-149 and now has addresses 120-1119: \
             addresses 120-149 are kept, addresses 100-119 are set aside",
            "one: input_registers had addresses 0-3 and now has no addresses: no address is kept, \
             addresses 0-3 are set aside",
            "one: set aside in the file: coils 3-9 and 15-42, holding_registers 100-119, \
             input_registers 0-3. Their values come back when the memory has these addresses \
             again; 'holdfast memory release' deletes them",
        ];
        assert_eq!(file.warnings(), &expected[if round == 0 { 0 } else { 4 }..]);
        file.stop().unwrap();
    }
}

#[test]
fn what_was_cut_comes_back_with_its_addresses() {
    let disk = Arc::new(SimDisk::default());
    let whole = layout(40, 600);
    let one = memory(whole.clone(), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    for address in 0..600 {
        set(&one, address, address + 1).unwrap();
    }
    let coils = Write { area: Area::Coils, address: 0, count: 40, bytes: &[0xff; 5] };
    one.write(Access::Ingest, coils).unwrap();
    file.stop().unwrap();
    let expected = contents(&one);
    // Each start lacks something else, and the last one lacks everything.
    let span = |start, size| Span::new(start, size).unwrap();
    let part =
        |coils, registers| Layout::default().with(Area::Coils, coils).with(REGISTERS, registers);
    for other in [
        part(span(3, 9), span(0, 100)),
        part(span(0, 40), span(500, 100)),
        part(span(20, 20), span(200, 10)),
        part(span(0, 0), span(0, 0)),
    ] {
        keep(&disk, &[("one", &memory(other, None))], at_once()).unwrap();
    }
    let again = memory(whole.clone(), None);
    let file = keep(&disk, &[("one", &again)], at_once()).unwrap();
    assert_eq!(contents(&again), expected);
    let back = "had no addresses and now has addresses 0-39: no address is kept, \
                addresses 0-39 are back";
    assert!(file.warnings()[0].ends_with(back), "{:?}", file.warnings());
    assert_eq!(file.warnings().len(), 2, "nothing is set aside any more");
    file.stop().unwrap();
    let file = keep(&disk, &[("one", &memory(whole, None))], at_once()).unwrap();
    assert!(file.warnings().is_empty());
    file.stop().unwrap();
    assert_eq!(read_from(&*disk).unwrap().len(), 1);
}

const VERSION_OF: TableDefinition<&str, u64> = TableDefinition::new("holdfast");

/// The version of the format of a file.
fn format_of(disk: &SimDisk) -> u64 {
    let path = folder("format").join("copy.redb");
    std::fs::write(&path, disk.bytes()).unwrap();
    let database = Database::open(&path).unwrap();
    let about = database.begin_read().unwrap().open_table(VERSION_OF).unwrap();
    about.get("format").unwrap().unwrap().value()
}

#[test]
fn older_programs_read_a_file_until_a_memory_in_it_has_files() {
    let disk = Arc::new(SimDisk::default());
    let plain = || memory(layout(3, 5), None);
    keep(&disk, &[("one", &plain())], at_once()).unwrap().stop().unwrap();
    assert_eq!(format_of(&disk), 1);
    let with_file = layout(3, 5).with(Area::File(4), Span::new(0, 2).unwrap());
    let two = memory(with_file, None);
    keep(&disk, &[("one", &plain()), ("two", &two)], at_once()).unwrap().stop().unwrap();
    assert_eq!(format_of(&disk), 2);
}

#[test]
fn files_keep_their_records_and_what_is_cut_comes_back() {
    let disk = Arc::new(SimDisk::default());
    let files = |files: &[(u16, u32)]| {
        let layout = files.iter().fold(layout(0, 1), |layout, (number, records)| {
            layout.with(Area::File(*number), Span::new(0, *records).unwrap())
        });
        memory(layout, None)
    };
    let record = |memory: &Memory, number: u16, record: u16| {
        let mut out = [0; 2];
        let read = Read { area: Area::File(number), address: record, count: 1, out: &mut out };
        memory.read(Access::Client, read).map(|()| u16::from_be_bytes(out))
    };
    let one = files(&[(4, 10_000), (7, 3)]);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    for (number, address, value) in [(4, 0, 1), (4, 9999, 2), (7, 2, 3)] {
        let bytes = u16::to_be_bytes(value);
        let write = Write { area: Area::File(number), address, count: 1, bytes: &bytes };
        one.write(Access::Client, write).unwrap();
    }
    file.stop().unwrap();
    // The files before and between others change their places.
    let other = files(&[(1, 500), (4, 5), (6, 1), (7, 4)]);
    let file = keep(&disk, &[("one", &other)], at_once()).unwrap();
    assert_eq!((record(&other, 4, 0), record(&other, 7, 2)), (Ok(1), Ok(3)));
    assert_eq!(record(&other, 4, 5), Err(Refusal::OutOfRange));
    let expected = "one: file:4 had addresses 0-9999 and now has addresses 0-4: addresses 0-4 are \
                    kept, addresses 5-9999 are set aside";
    assert!(file.warnings().iter().any(|warning| warning == expected), "{:?}", file.warnings());
    file.stop().unwrap();
    let again = files(&[(4, 10_000), (7, 3)]);
    keep(&disk, &[("one", &again)], at_once()).unwrap().stop().unwrap();
    assert_eq!(contents(&again), contents(&one));
    let stored = read_from(&*disk).unwrap();
    let stored = stored.iter().find(|stored| stored.name == "one").unwrap();
    assert_eq!(stored.bytes_of(Area::File(7)), [0, 0, 0, 0, 0, 3]);
    assert!(stored.bytes_of(Area::File(1)).is_empty());
}

#[test]
fn what_comes_back_is_as_new_as_the_cut() {
    let disk = Arc::new(SimDisk::default());
    for (registers, value) in [(10, 1), (5, 0), (10, 2), (5, 0), (10, 3)] {
        let one = memory(layout(0, registers), None);
        let _file = keep(&disk, &[("one", &one)], at_once()).unwrap();
        if value > 0 {
            assert_eq!(get(&one, 9), value - 1);
            set(&one, 9, value).unwrap();
        }
    }
}

#[test]
fn a_seal_that_comes_back_is_closed() {
    let disk = Arc::new(SimDisk::default());
    let gate = Gate { area: Area::Coils, address: 9, mode: GateMode::Once };
    let one = memory(layout(10, 10), Some(gate));
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    let open = Write { area: Area::Coils, address: 8, count: 2, bytes: &[3] };
    one.write(Access::Ingest, open).unwrap();
    assert!(!one.sealed());
    file.stop().unwrap();
    keep(&disk, &[("one", &memory(layout(0, 10), None))], at_once()).unwrap();
    let again = memory(layout(10, 10), Some(gate));
    keep(&disk, &[("one", &again)], at_once()).unwrap();
    assert!(again.sealed());
    assert_eq!(contents(&again).areas[0][1], 1, "the gate bit is 0, the one before it came back");
}

#[test]
fn what_was_cut_is_deleted_when_it_is_released() {
    let disk = Arc::new(SimDisk::default());
    assert!(matches!(release(Arc::clone(&disk) as _, "one"), Err(FileError::Io(_))));
    let (one, two) = (memory(layout(0, 10), None), memory(layout(0, 10), None));
    let file = keep(&disk, &[("one", &one), ("two", &two)], at_once()).unwrap();
    set(&one, 9, 1).unwrap();
    set(&two, 9, 2).unwrap();
    file.stop().unwrap();
    let small = || memory(layout(0, 5), None);
    keep(&disk, &[("one", &small()), ("two", &small())], at_once()).unwrap();
    assert!(release(Arc::clone(&disk) as _, "one").unwrap());
    assert!(!release(Arc::clone(&disk) as _, "one").unwrap());
    let (one, two) = (memory(layout(0, 10), None), memory(layout(0, 10), None));
    keep(&disk, &[("one", &one), ("two", &two)], at_once()).unwrap();
    assert_eq!((get(&one, 9), get(&two, 9)), (0, 2));
}

#[test]
fn a_memory_that_is_not_configured_stays_in_the_file() {
    let disk = Arc::new(SimDisk::default());
    let (one, two) = (memory(layout(0, 10), None), memory(layout(0, 10), None));
    let file = keep(&disk, &[("one", &one), ("two", &two)], at_once()).unwrap();
    set(&one, 1, 11).unwrap();
    set(&two, 2, 22).unwrap();
    file.stop().unwrap();
    let two = memory(layout(0, 10), None);
    let three = memory(layout(0, 10), None);
    let file = keep(&disk, &[("three", &three), ("two", &two)], at_once()).unwrap();
    assert_eq!(file.loaded(), ["two"]);
    assert_eq!(file.warnings(), ["one: is in the file but not configured, and stays there"]);
    set(&three, 3, 33).unwrap();
    disk.set_broken(true);
    assert_eq!(set(&three, 3, 0), Err(Refusal::NotStored));
    disk.set_broken(false);
    set(&two, 4, 44).unwrap();
    file.stop().unwrap();
    let memories: Vec<Arc<Memory>> = (0..3).map(|_| memory(layout(0, 10), None)).collect();
    let named = [("one", &memories[0]), ("two", &memories[1]), ("three", &memories[2])];
    let file = keep(&disk, &named, at_once()).unwrap();
    assert_eq!(file.loaded(), ["one", "two", "three"]);
    assert_eq!(get(&memories[0], 1), 11);
    assert_eq!((get(&memories[1], 2), get(&memories[1], 4)), (22, 44));
    assert_eq!(get(&memories[2], 3), 33);
}

#[test]
fn memories_that_cannot_be_kept_together_are_refused() {
    let disk = Arc::new(SimDisk::default());
    let (one, two) = (memory(layout(0, 10), None), memory(layout(0, 10), None));
    for members in [[("a", &one), ("a", &two)], [("a", &one), ("b", &one)]] {
        let error = keep(&disk, &members, at_once()).unwrap_err();
        assert!(matches!(error, FileError::Memories(_)), "{error}");
    }
    let error = keep(&disk, &[("a:set-aside", &one)], at_once()).unwrap_err();
    let expected = "memory a:set-aside: :set-aside at the end of a name is not allowed";
    assert_eq!(error.to_string(), expected);
    let _file = keep(&disk, &[("a", &one)], at_once()).unwrap();
    let other = Arc::new(SimDisk::default());
    let error = keep(&other, &[("a", &one)], at_once()).unwrap_err();
    assert_eq!(error.to_string(), "memory a is kept elsewhere already");
}

#[test]
fn with_a_time_writes_are_not_held_up() {
    let disk = Arc::new(SimDisk::default());
    let one = memory(layout(0, 10), None);
    let file = keep(&disk, &[("one", &one)], Options::new(Duration::from_millis(1))).unwrap();
    disk.hold(true);
    for value in 1..1000 {
        set(&one, 0, value).unwrap();
    }
    assert!(file.status().pending > 0);
    disk.hold(false);
    until("storing", || file.status().pending == 0);
    let again = memory(layout(0, 10), None);
    keep(&Arc::new(SimDisk::with_file(disk.bytes())), &[("one", &again)], at_once()).unwrap();
    assert_eq!(get(&again, 0), 999);
}
