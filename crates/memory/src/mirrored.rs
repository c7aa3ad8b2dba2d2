//! Ranges that mirror a device: which access may write them, and when they may not be used.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use crate::area::Area;
use crate::operation::Write;

/// Whether the values of a range are too old. It is called with the locks of a memory, for each access
/// to the range: it must not wait.
pub trait Freshness: fmt::Debug + Send + Sync {
    /// [`Access::Mirror`](crate::Access::Mirror) has written the whole range, with values that are at most
    /// this old, under this lease if the journal knows one. Those of before were older.
    fn renew(&self, age: Duration, lease: Option<u64>);

    /// Whether only the mirror may read or write the range now.
    fn must_refuse(&self) -> bool;
}

/// Items that [`Access::Mirror`](crate::Access::Mirror) writes.
#[derive(Debug, Clone)]
pub struct Mirrored {
    pub area: Area,
    pub address: u16,
    pub count: usize,
    /// Whether only the mirror writes them.
    pub is_reserved: bool,
    pub freshness: Option<Arc<dyn Freshness>>,
}

impl Mirrored {
    /// Items that only the mirror writes, and that never become stale.
    pub const fn reserved(area: Area, address: u16, count: usize) -> Mirrored {
        Mirrored { area, address, count, is_reserved: true, freshness: None }
    }

    pub(crate) fn must_refuse(&self) -> bool {
        self.freshness.as_deref().is_some_and(Freshness::must_refuse)
    }

    /// Whether a write covers all items.
    pub(crate) fn is_in(&self, write: &Write<'_>) -> bool {
        let (start, first) = (usize::from(write.address), usize::from(self.address));
        self.area == write.area && start <= first && first + self.count <= start + write.count
    }

    fn overlaps(&self, area: Area, address: u16, count: usize) -> bool {
        let (start, first) = (usize::from(address), usize::from(self.address));
        self.area == area && start < first + self.count && first < start + count
    }
}

/// All mirrored ranges of a memory. They may overlap.
#[derive(Debug, Default)]
pub(crate) struct MirroredRanges {
    /// Sorted by area and address.
    ranges: Vec<Mirrored>,
    /// The largest count.
    longest: usize,
}

impl MirroredRanges {
    pub(crate) fn new(mut ranges: Vec<Mirrored>) -> MirroredRanges {
        ranges.sort_by_key(|range| (range.area, range.address));
        let longest = ranges.iter().map(|range| range.count).max().unwrap_or_default();
        MirroredRanges { ranges, longest }
    }

    pub(crate) fn can_be_stale(&self) -> bool {
        self.ranges.iter().any(|range| range.freshness.is_some())
    }

    /// The ranges that have an item in common with this one.
    pub(crate) fn touched(
        &self,
        area: Area,
        address: u16,
        count: usize,
    ) -> impl Iterator<Item = &Mirrored> {
        let (start, end) = (usize::from(address), usize::from(address) + count);
        let place = |range: &Mirrored| (range.area, usize::from(range.address));
        let from = self.ranges.partition_point(|range| {
            let (of, first) = place(range);
            (of, first + self.longest) <= (area, start)
        });
        let to = self.ranges.partition_point(|range| place(range) < (area, end));
        let near = self.ranges.get(from..to).unwrap_or_default();
        near.iter().filter(move |range| range.overlaps(area, address, count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_is_in_a_write_of_all_its_items() {
        let range = Mirrored::reserved(Area::HoldingRegisters, 10, 3);
        for (address, count, is_in) in [
            (10, 3, true),
            (9, 4, true),
            (10, 9, true),
            (0, 13, true),
            (0, 12, false),
            (10, 2, false),
            (11, 3, false),
            (9, 3, false),
            (13, 3, false),
        ] {
            let write = Write { area: Area::HoldingRegisters, address, count, bytes: &[] };
            assert_eq!(range.is_in(&write), is_in, "{address} {count}");
            assert!(!range.is_in(&Write { area: Area::InputRegisters, ..write }));
        }
    }

    #[test]
    fn the_touched_ranges_are_those_with_an_item_in_common() {
        let areas = [Area::Coils, Area::HoldingRegisters];
        let places = [(0, 1), (3, 4), (3, 1), (9, 1), (8, 2), (65_530, 6), (20, 30), (60, 1)];
        let all: Vec<Mirrored> = areas
            .into_iter()
            .flat_map(|area| places.map(|(at, count)| Mirrored::reserved(area, at, count)))
            .collect();
        let ranges = MirroredRanges::new(all.clone());
        let place = |range: &Mirrored| (range.area, range.address, range.count);
        let starts = (0..64).chain(65_520..=65_535);
        for (address, count) in starts.flat_map(|at| [1, 2, 7, 60].map(|count| (at, count))) {
            for area in Area::ALL {
                let touched = ranges.touched(area, address, count).map(place);
                let mut found: Vec<_> = touched.collect();
                let with = all.iter().filter(|range| range.overlaps(area, address, count));
                let mut expected: Vec<_> = with.map(place).collect();
                found.sort_unstable();
                expected.sort_unstable();
                assert_eq!(found, expected, "{area:?} {address} {count}");
            }
        }
    }
}
