//! A file of memories, with damage: parts of a place and a byte that is combined with what is there.

use std::sync::{Arc, OnceLock};

use holdfast_journal::file::{StoredMemory, read_from};
use holdfast_memory::{Access, Area, Write};

use crate::journal_support::sim::SimDisk;
use crate::journal_support::{at_once, keep, layout, memory, set};

/// The bytes of a change: its place and what changes there.
const CHANGE_LEN: usize = 4;

/// A damaged file is refused, or has what was stored. No change, no damage.
pub fn check(data: &[u8]) {
    static STORED: OnceLock<(Vec<u8>, Vec<StoredMemory>)> = OnceLock::new();
    let (whole, expected) = STORED.get_or_init(stored);
    let mut bytes = whole.clone();
    for change in data.chunks(CHANGE_LEN) {
        match *change {
            [high, middle, low, bits] => {
                let at = u32::from_be_bytes([0, high, middle, low]) as usize;
                let at = at % bytes.len();
                bytes[at] ^= bits;
            }
            // The last one cuts the file.
            [high, low] => {
                let cut = usize::from(u16::from_be_bytes([high, low]));
                bytes.truncate(bytes.len().saturating_sub(cut));
            }
            _ => {}
        }
        if bytes.is_empty() {
            break;
        }
    }
    let is_whole = bytes == *whole;
    match read_from(&SimDisk::with_file(bytes)) {
        Ok(found) => assert_eq!(found, *expected),
        Err(error) => assert!(!is_whole, "{error}"),
    }
}

fn stored() -> (Vec<u8>, Vec<StoredMemory>) {
    let disk = Arc::new(SimDisk::default());
    let (one, two) = (memory(layout(77, 3000), None), memory(layout(0, 200), None));
    let file = keep(&disk, &[("one", &one), ("two", &two)], at_once()).expect("a new file");
    for number in 0..40 {
        set(&one, number * 70, number).expect("a register of the memory");
        set(&two, number, !number).expect("a register of the memory");
    }
    let coils = Write { area: Area::Coils, address: 3, count: 9, bytes: &[0x55, 1] };
    one.write(Access::Ingest, coils).expect("coils of the memory");
    file.stop().expect("a disk that works");
    let bytes = disk.bytes();
    let memories = read_from(&*disk).expect("a whole file");
    (bytes, memories)
}
