//! Files that are not as they were stored: an error, or exactly the contents; never a panic.

mod support;

use std::sync::Arc;

use holdfast_journal::file::{Disk, FileError, FileOnDisk, read_from};
use holdfast_memory::{Access, Area, Contents, Memory, Write};
use redb::{Database, ReadableDatabase, TableDefinition};
use support::sim::SimDisk;
use support::{
    REGISTERS, Random, at_once, contents, get, keep, layout, member, memory, rounds, set,
};

/// A file after a clean stop, and what is in it.
fn stored() -> (Vec<u8>, [Contents; 2]) {
    let disk = Arc::new(SimDisk::default());
    let (one, two) = (memory(layout(77, 3000), None), memory(layout(0, 200), None));
    let file = keep(&disk, &[("one", &one), ("two", &two)], at_once()).unwrap();
    let mut random = Random(1);
    for _ in 0..300 {
        set(&one, random.below(3000) as u16, random.below(65_536) as u16).unwrap();
        set(&two, random.below(200) as u16, random.below(65_536) as u16).unwrap();
    }
    let coils = Write { area: Area::Coils, address: 3, count: 9, bytes: &[0x55, 1] };
    one.write(Access::Ingest, coils).unwrap();
    file.stop().unwrap();
    (disk.bytes(), [contents(&one), contents(&two)])
}

/// Opens a file that may be damaged. Returns whether it was refused.
fn is_refused(what: &str, bytes: Vec<u8>, expected: &[Contents; 2]) -> bool {
    let disk = Arc::new(SimDisk::with_file(bytes.clone()));
    let (one, two) = (memory(layout(77, 3000), None), memory(layout(0, 200), None));
    let checked = read_from(&*disk);
    assert_eq!(disk.operations(), 0, "{what}: a check changes nothing");
    match keep(&disk, &[("one", &one), ("two", &two)], at_once()) {
        Ok(file) => {
            assert_eq!(file.loaded(), ["one", "two"], "{what}");
            assert_eq!(&[contents(&one), contents(&two)], expected, "{what}");
            assert!(checked.is_ok(), "{what}");
            false
        }
        Err(FileError::Memories(_) | FileError::Locked) => panic!("{what}: a wrong error"),
        Err(_) => {
            assert_eq!(disk.bytes(), bytes, "{what}: a damaged file is unchanged");
            assert!(contents(&one).areas[2].iter().all(|byte| *byte == 0));
            assert!(checked.is_err(), "{what}");
            true
        }
    }
}

#[test]
fn flipped_bits_never_make_other_contents() {
    let (bytes, expected) = stored();
    let mut random = Random(7);
    let mut refused = 0;
    let count = rounds(150, 20_000);
    for round in 0..count {
        let mut damaged = bytes.clone();
        let at = random.below(bytes.len() as u64) as usize;
        damaged[at] ^= 1 << random.below(8);
        refused += u64::from(is_refused(&format!("round {round}, byte {at}"), damaged, &expected));
    }
    assert!(refused > 0 && refused < count, "{refused}");
}

#[test]
fn flipped_bits_in_the_header_never_make_other_contents() {
    let (bytes, expected) = stored();
    let mut refused = 0;
    for at in 0..320 {
        for bit in 0..rounds(1, 8) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1 << ((bit * 5 + at as u64) % 8);
            refused += u64::from(is_refused(&format!("byte {at}"), damaged, &expected));
        }
    }
    assert!(refused > 0);
    for bit in 0..8 {
        let mut damaged = bytes.clone();
        damaged[9] ^= 1 << bit;
        is_refused(&format!("bit {bit} of the flags"), damaged, &expected);
    }
}

#[test]
fn flipped_bits_in_every_stored_page_are_refused() {
    let (bytes, expected) = stored();
    // Pages are in the file several times: older ones, which are free now, may have any contents.
    for (memory, pages) in [(0, 24), (1, 2)] {
        for page in 0..pages {
            let content = &expected[memory].areas[2];
            let content = &content[page * 256..(page * 256 + 256).min(content.len())];
            let mut damaged = bytes.clone();
            let mut found = 0;
            for at in 0..bytes.len() - content.len() {
                if bytes[at..].starts_with(content) {
                    damaged[at + 5] ^= 4;
                    found += 1;
                }
            }
            assert!(found > 0);
            assert!(is_refused(&format!("page {page}"), damaged, &expected));
        }
    }
}

#[test]
fn lost_and_exchanged_sectors_never_make_other_contents() {
    let (bytes, expected) = stored();
    let mut random = Random(9);
    for round in 0..rounds(60, 10_000) {
        let mut damaged = bytes.clone();
        let sectors = bytes.len() as u64 / 512;
        let mut pick = || random.below(sectors) as usize * 512;
        let (at, other) = (pick(), pick());
        if round % 2 == 0 {
            damaged[at..at + 512].fill(0);
        } else {
            damaged.copy_within(at..at + 512, other);
        }
        is_refused(&format!("round {round}, sectors {at} {other}"), damaged, &expected);
    }
}

#[test]
fn truncated_and_extended_files_never_make_other_contents() {
    let (bytes, expected) = stored();
    let mut random = Random(5);
    for round in 0..rounds(40, 5000) {
        let len = random.below(bytes.len() as u64) as usize;
        let len = if round % 2 == 0 { len / 4096 * 4096 } else { len };
        is_refused(&format!("{len} bytes"), bytes[..len].to_vec(), &expected);
    }
    assert!(is_refused("no byte", Vec::new(), &expected));
    let mut longer = bytes.clone();
    for more in [1, 4096, 1 << 20] {
        longer.resize(bytes.len() + more, 0xff);
        is_refused(&format!("{more} more"), longer.clone(), &expected);
    }
}

#[test]
fn random_bytes_are_refused() {
    let (bytes, expected) = stored();
    let mut random = Random(5);
    for _ in 0..rounds(5, 1000) {
        let mut noise: Vec<u8> = (0..bytes.len()).map(|_| random.below(256) as u8).collect();
        assert!(is_refused("noise", noise.clone(), &expected));
        noise[..320].copy_from_slice(&bytes[..320]);
        assert!(is_refused("noise behind the header", noise, &expected));
    }
}

fn path(name: &str) -> std::path::PathBuf {
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_file(&path);
    path
}

fn refusal(path: &std::path::Path) -> String {
    let one = memory(layout(8, 8), None);
    let error = keep(&Arc::new(FileOnDisk::new(path)), &[("one", &one)], at_once()).unwrap_err();
    assert!(!one.has_journal());
    error.to_string()
}

#[test]
fn files_of_others_are_refused() {
    let path = path("foreign.redb");
    const OTHERS: TableDefinition<&str, u64> = TableDefinition::new("prices");
    let database = Database::create(&path).unwrap();
    let transaction = database.begin_write().unwrap();
    transaction.open_table(OTHERS).unwrap().insert("bread", 3).unwrap();
    transaction.commit().unwrap();
    assert_eq!(refusal(&path), "the file is in use by another process");
    drop(database);
    assert_eq!(refusal(&path), "not a file of memories: a redb file of another program");
    std::fs::write(&path, "coils").unwrap();
    assert_eq!(refusal(&path), "not a file of memories: it begins with coil");
    std::fs::write(&path, "").unwrap();
    assert!(refusal(&path).starts_with("the file is damaged: it has 0 bytes"));
    let folder = path.parent().unwrap();
    assert_eq!(refusal(folder), "not a file of memories: a directory");
    assert!(refusal(&folder.join("none/file")).contains("No such file") || cfg!(windows));
}

#[test]
fn files_of_newer_releases_are_refused() {
    let path = path("newer.redb");
    const ABOUT: TableDefinition<&str, u64> = TableDefinition::new("holdfast");
    let disk = Arc::new(FileOnDisk::new(&path));
    let one = memory(layout(8, 8), None);
    keep(&disk, &[("one", &one)], at_once()).unwrap().stop().unwrap();
    let set_version = |version| {
        let database = Database::open(&path).unwrap();
        let transaction = database.begin_write().unwrap();
        transaction.open_table(ABOUT).unwrap().insert("format", version).unwrap();
        transaction.commit().unwrap();
        let found = database.begin_read().unwrap().open_table(ABOUT).unwrap();
        assert_eq!(found.get("format").unwrap().unwrap().value(), version);
    };
    set_version(3);
    let expected = "the file is of a newer release: its format version is 3, allowed: 2";
    assert_eq!(refusal(&path), expected);
    set_version(0);
    assert!(refusal(&path).contains("damaged"));
}

#[test]
fn a_file_in_use_is_refused_and_can_be_used_afterwards() {
    let path = path("locked.redb");
    let (disk, other) = (FileOnDisk::new(&path), FileOnDisk::new(&path));
    let (disk, other) = (Arc::new(disk), Arc::new(other));
    let one = memory(layout(8, 8), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    set(&one, 1, 7).unwrap();
    assert_eq!(refusal(&path), "the file is in use by another process");
    assert!(matches!(read_from(&*other), Err(FileError::Locked)));
    set(&one, 2, 8).unwrap();
    file.stop().unwrap();
    let two = memory(layout(8, 8), None);
    let _file = keep(&other, &[("one", &two)], at_once()).unwrap();
    assert_eq!((get(&two, 1), get(&two, 2)), (7, 8));
}

#[test]
fn a_file_is_read_without_a_change() {
    let path = path("read.redb");
    let disk = Arc::new(FileOnDisk::new(&path));
    assert!(matches!(read_from(&*disk), Err(FileError::Io(_))));
    let one = memory(layout(9, 300), None);
    let file = keep(&disk, &[("one", &one)], at_once()).unwrap();
    set(&one, 1, 7).unwrap();
    file.stop().unwrap();
    let before = std::fs::read(&path).unwrap();
    let memories = read_from(&*disk).unwrap();
    assert_eq!(memories.len(), 1);
    assert_eq!((&*memories[0].name, &memories[0].areas), ("one", &contents(&one).areas));
    assert_eq!(memories[0].layout.span(REGISTERS), one.span(REGISTERS));
    assert_eq!(std::fs::read(&path).unwrap(), before);
    assert!(Disk::size(&*disk).unwrap().is_some());
    let _ = (member("one", &one), Memory::writes(&one));
}
