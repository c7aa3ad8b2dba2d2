//! Follows ranges of a memory: what has changed since the last look.

use std::sync::Arc;

use crate::area::Area;
use crate::bits;
use crate::error::{Refusal, Refused};
use crate::memory::Memory;
use crate::operation::Read;

/// Ranges of a memory, and their content at the last look.
///
/// It looks only when asked. Writers do no work for it, except that they count their writes.
#[derive(Debug)]
pub struct Follower {
    memory: Arc<Memory>,
    ranges: Vec<Followed>,
    /// The number of writes at the last look; `None` before the first.
    seen: Option<u64>,
}

#[derive(Debug)]
struct Followed {
    area: Area,
    address: u16,
    count: usize,
    before: Vec<u8>,
    now: Vec<u8>,
}

/// The shortest part of a range that contains all its changes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Change {
    /// The index of the range.
    pub range: usize,
    pub area: Area,
    pub address: u16,
    pub count: usize,
    pub bytes: Vec<u8>,
}

impl Follower {
    /// Follows ranges, each an area, its first address and a count.
    ///
    /// # Errors
    /// As [`Memory::read_many`], without `Sealed`.
    pub fn new(
        memory: Arc<Memory>,
        ranges: impl IntoIterator<Item = (Area, u16, usize)>,
    ) -> Result<Follower, Refused> {
        let mut followed = Vec::new();
        for (index, (area, address, count)) in ranges.into_iter().enumerate() {
            memory.holds(area, address, count).map_err(|refusal| Refused { index, refusal })?;
            let empty = vec![0; area.byte_len(count)];
            followed.push(Followed { area, address, count, before: empty.clone(), now: empty });
        }
        Ok(Follower { memory, ranges: followed, seen: None })
    }

    /// Returns the changes since the last call, of all ranges at the same moment, and the number of
    /// writes to the memory up to then. The first call, and the first one after an error, return all
    /// ranges as a whole. Changes are empty if every range is as before.
    ///
    /// # Errors
    /// Those of [`Journal::admit`](crate::Journal::admit): the contents may be old or wrong.
    pub fn changes(&mut self) -> Result<(u64, Vec<Change>), Refusal> {
        let mut reads: Vec<Read> = self.ranges.iter_mut().map(Followed::reading).collect();
        let read = self.memory.read_since(self.seen, &mut reads);
        let writes = read.inspect_err(|_| self.seen = None)?;
        let mut changes = Vec::new();
        if self.seen != Some(writes) {
            let is_first = self.seen.is_none();
            for (index, range) in self.ranges.iter_mut().enumerate() {
                changes.extend(range.change(index, is_first));
            }
            self.seen = Some(writes);
        }
        Ok((writes, changes))
    }
}

impl Followed {
    fn reading(&mut self) -> Read<'_> {
        Read { area: self.area, address: self.address, count: self.count, out: &mut self.now }
    }

    /// What is new, which is then known.
    fn change(&mut self, range: usize, whole: bool) -> Option<Change> {
        let differs = |at: &usize| whole || self.item_differs(*at);
        let change = if whole || self.now != self.before {
            let first = (0..self.count).find(differs)?;
            let last = (0..self.count).rfind(differs)?;
            let count = last - first + 1;
            let mut bytes = vec![0; self.area.byte_len(count)];
            self.area.copy_out(&self.now, first, count, &mut bytes);
            let address = self.address + first as u16;
            Some(Change { range, area: self.area, address, count, bytes })
        } else {
            None
        };
        std::mem::swap(&mut self.before, &mut self.now);
        change
    }

    fn item_differs(&self, at: usize) -> bool {
        if self.area.is_bits() {
            bits::get(&self.now, at) != bits::get(&self.before, at)
        } else {
            self.now[at * 2..at * 2 + 2] != self.before[at * 2..at * 2 + 2]
        }
    }
}
