//! Writes that go to memory instead of the file, so that a file can be repaired and checked without
//! changing it.

use std::collections::HashMap;
use std::io;
use std::ops::Bound;
use std::sync::Mutex;

use holdfast_runtime::lock;
use redb::{BackendError, StorageBackend};

/// The unit in which changed bytes are copied.
const BLOCK_BYTES: u64 = 4096;

/// A file that is only read, with changes in memory.
#[derive(Debug)]
pub struct Overlay<B> {
    below: B,
    changes: Mutex<Changes>,
}

#[derive(Debug, Default)]
struct Changes {
    /// The length, and how much of the file is still visible; the file's length at first.
    len: Option<(u64, u64)>,
    blocks: HashMap<u64, Box<[u8; BLOCK_BYTES as usize]>>,
}

impl<B: StorageBackend> Overlay<B> {
    pub fn new(below: B) -> Overlay<B> {
        Overlay { below, changes: Mutex::default() }
    }

    fn lens(&self, changes: &Changes) -> io::Result<(u64, u64)> {
        changes.len.map_or_else(|| self.below.len().map(|len| (len, len)), Ok)
    }

    /// Reads a part of one block.
    fn read_part(&self, changes: &Changes, offset: u64, out: &mut [u8]) -> io::Result<()> {
        if let Some(block) = changes.blocks.get(&(offset / BLOCK_BYTES)) {
            let from = (offset % BLOCK_BYTES) as usize;
            out.copy_from_slice(&block[from..from + out.len()]);
            return Ok(());
        }
        let (_, visible) = self.lens(changes)?;
        let len = usize::try_from(visible.saturating_sub(offset)).unwrap_or(usize::MAX);
        let (file, behind) = out.split_at_mut(len.min(out.len()));
        behind.fill(0);
        if file.is_empty() { Ok(()) } else { self.below.read(offset, file) }
    }
}

/// Splits `len` bytes from `offset` at the borders of blocks: where each part begins, in the file and
/// in the buffer, and its length.
fn parts(offset: u64, len: usize) -> impl Iterator<Item = (u64, usize, usize)> {
    let mut done = 0;
    std::iter::from_fn(move || {
        let at = offset + done as u64;
        let part = ((BLOCK_BYTES - at % BLOCK_BYTES) as usize).min(len - done);
        let from = done;
        done += part;
        (part > 0).then_some((at, from, part))
    })
}

impl<B: StorageBackend> StorageBackend for Overlay<B> {
    fn len(&self) -> io::Result<u64> {
        self.lens(&lock(&self.changes)).map(|(len, _)| len)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let changes = lock(&self.changes);
        let (len, _) = self.lens(&changes)?;
        if offset.checked_add(out.len() as u64).is_none_or(|end| end > len) {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        for (at, from, part) in parts(offset, out.len()) {
            self.read_part(&changes, at, &mut out[from..from + part])?;
        }
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        let mut changes = lock(&self.changes);
        let (_, visible) = self.lens(&changes)?;
        changes.blocks.retain(|block, _| block * BLOCK_BYTES < len);
        let cut = (len % BLOCK_BYTES) as usize;
        if let Some(block) = changes.blocks.get_mut(&(len / BLOCK_BYTES)) {
            block[cut..].fill(0);
        }
        changes.len = Some((len, visible.min(len)));
        Ok(())
    }

    fn sync_data(&self) -> io::Result<()> {
        Ok(())
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let mut changes = lock(&self.changes);
        let (len, _) = self.lens(&changes)?;
        if offset.checked_add(data.len() as u64).is_none_or(|end| end > len) {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        for (at, from, part) in parts(offset, data.len()) {
            let mut block = Box::new([0; BLOCK_BYTES as usize]);
            self.read_part(&changes, at - at % BLOCK_BYTES, &mut block[..])?;
            let within = (at % BLOCK_BYTES) as usize;
            block[within..within + part].copy_from_slice(&data[from..from + part]);
            changes.blocks.insert(at / BLOCK_BYTES, block);
        }
        Ok(())
    }

    fn close(&self) -> io::Result<()> {
        self.below.close()
    }

    // A reader shares the file with other readers.
    fn try_lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.below.try_lock_shared_range(start, end)
    }

    fn try_lock_shared_range(
        &self,
        start: Bound<u64>,
        end: Bound<u64>,
    ) -> Result<bool, BackendError> {
        self.below.try_lock_shared_range(start, end)
    }

    fn unlock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.below.unlock_range(start, end)
    }
}
