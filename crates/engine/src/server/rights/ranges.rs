//! The ranges that a peer may read and write.

use holdfast_memory::Area;
use holdfast_protocol::pdu::{FileRange, Request};

use crate::items::{Items, touched};

/// Ranges of areas, for reading and for writing; `None` is everything.
#[derive(Debug, Clone, Default)]
pub struct Ranges {
    read: Option<Vec<Items>>,
    write: Option<Vec<Items>>,
}

impl Ranges {
    pub fn new(read: Option<Vec<Items>>, write: Option<Vec<Items>>) -> Ranges {
        Ranges { read: read.map(joined), write: write.map(joined) }
    }

    pub(in crate::server) fn is_everything(&self) -> bool {
        self.read.is_none() && self.write.is_none()
    }

    /// Whether a request reads and writes only inside the ranges.
    pub(crate) fn allow(&self, request: &Request<'_>) -> bool {
        let of_file = |range: FileRange| Items {
            area: Area::File(range.file()),
            address: range.record(),
            count: range.quantity().into(),
        };
        match request {
            Request::ReadFileRecord(ranges) => {
                ranges.iter().all(|range| self.allow_read(of_file(range)))
            }
            Request::WriteFileRecord(records) => {
                records.iter().all(|(range, _)| is_inside(of_file(range), &self.write))
            }
            _ => {
                let (read, written) = touched(request);
                read.is_none_or(|items| self.allow_read(items))
                    && written.is_none_or(|items| is_inside(items, &self.write))
            }
        }
    }

    pub(crate) fn allow_read(&self, items: Items) -> bool {
        is_inside(items, &self.read)
    }
}

fn is_inside(items: Items, ranges: &Option<Vec<Items>>) -> bool {
    ranges.as_ref().is_none_or(|ranges| ranges.iter().any(|range| items.is_in(*range)))
}

/// Joins ranges that meet, so that a request may cross from one into the other.
fn joined(mut ranges: Vec<Items>) -> Vec<Items> {
    ranges.sort_by_key(|range| (range.area, range.address));
    let mut all: Vec<Items> = Vec::new();
    for range in ranges {
        match all.last_mut() {
            Some(last) if last.area == range.area && u32::from(range.address) <= last.end() => {
                last.count = range.end().max(last.end()) - u32::from(last.address);
            }
            _ => all.push(range),
        }
    }
    all
}
