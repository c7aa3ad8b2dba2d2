//! Flattens large batches before any lock is taken. The copy under the lock is then never larger
//! than the memory, and has as few pieces as possible.

use crate::area::Area;
use crate::operation::Write;

/// Limits of batches that are copied without flattening: allocating an image costs more than copying them.
const MAX_DIRECT_WRITES: usize = 16;
const MAX_DIRECT_BYTES: usize = 16 * 1024;

/// Adjacent items of one area, each with the value of the last write to it.
#[derive(Debug)]
pub(crate) struct Run {
    address: u16,
    count: usize,
    bytes: Vec<u8>,
}

impl Run {
    pub(crate) fn writing(&self, area: Area) -> Write<'_> {
        Write { area, address: self.address, count: self.count, bytes: &self.bytes }
    }
}

/// Whether flattening these writes saves more time than it costs.
pub(crate) fn is_large<'w>(writes: impl ExactSizeIterator<Item = &'w Write<'w>>) -> bool {
    writes.len() > MAX_DIRECT_WRITES
        || (writes.len() > 1
            && writes.map(|write| write.bytes.len()).sum::<usize>() > MAX_DIRECT_BYTES)
}

/// Merges writes to one area into runs, sorted by address. The writes must have been checked.
pub(crate) fn flatten<'w>(writes: impl Iterator<Item = &'w Write<'w>> + Clone) -> Vec<Run> {
    let Some(&Write { area, .. }) = writes.clone().next() else { return Vec::new() };
    let (start, end) = writes.clone().fold((usize::MAX, 0), |(start, end), write| {
        let at = usize::from(write.address);
        (start.min(at), end.max(at + write.count))
    });
    let mut image = vec![0; area.byte_len(end - start)];
    let mut written = vec![false; end - start];
    for write in writes {
        debug_assert_eq!(write.area, area);
        let at = usize::from(write.address) - start;
        written[at..at + write.count].fill(true);
        area.copy_in(&mut image, at, write.count, write.bytes);
    }
    let mut runs: Vec<Run> = Vec::new();
    let mut at = 0;
    for chunk in written.chunk_by(|a, b| a == b) {
        let count = chunk.len();
        if chunk[0] {
            let mut bytes = vec![0; area.byte_len(count)];
            area.copy_out(&image, at, count, &mut bytes);
            runs.push(Run { address: (start + at) as u16, count, bytes });
        }
        at += count;
    }
    debug_assert!(
        runs.is_sorted_by(|a, b| usize::from(a.address) + a.count < usize::from(b.address)),
        "runs are sorted by address and do not touch"
    );
    runs
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flattened(area: Area, writes: &[(u16, usize, &[u8])]) -> Vec<(u16, usize, Vec<u8>)> {
        let write = |&(address, count, bytes)| Write { area, address, count, bytes };
        let writes: Vec<Write> = writes.iter().map(write).collect();
        let runs = flatten(writes.iter()).into_iter();
        runs.map(|run| (run.address, run.count, run.bytes)).collect()
    }

    #[test]
    fn runs_have_the_last_value_of_each_item_and_end_at_gaps() {
        assert_eq!(
            flattened(
                Area::HoldingRegisters,
                &[
                    (30, 1, &[7, 7]),
                    (10, 2, &[1, 1, 2, 2]),
                    (20, 1, &[3, 3]),
                    (11, 1, &[9, 9]),
                    (21, 1, &[4, 4]),
                ]
            ),
            [(10, 2, vec![1, 1, 9, 9]), (20, 2, vec![3, 3, 4, 4]), (30, 1, vec![7, 7])]
        );
        assert_eq!(
            flattened(
                Area::Coils,
                &[(3, 9, &[0xFF, 0xFF]), (20, 3, &[0b101]), (5, 2, &[0b10]), (40, 1, &[1])]
            ),
            [(3, 9, vec![0b1111_1011, 1]), (20, 3, vec![0b101]), (40, 1, vec![1])]
        );
        assert!(flattened(Area::Coils, &[]).is_empty());
    }
}
