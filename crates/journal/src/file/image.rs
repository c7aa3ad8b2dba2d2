//! What a file contains: memories, in pages.

use holdfast_memory::{Area, Contents, Layout, Memory, Span};

use super::error::FileError;

/// The number of bytes of a page: 128 registers or 2048 bits. One register costs little to store, and a
/// whole area has few pages.
pub(super) const PAGE: usize = 256;

/// A memory as it is in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    pub name: String,
    /// Its number in the file.
    pub(super) id: u16,
    pub layout: Layout,
    /// The bytes of all areas, in the order of [`Area::ALL`].
    pub areas: [Box<[u8]>; 4],
}

/// A page to store.
#[derive(Debug, Clone)]
pub(super) struct Page {
    pub memory: u16,
    pub area: u8,
    pub number: u16,
    pub bytes: Vec<u8>,
}

/// What a transaction changes.
#[derive(Debug, Default)]
pub(super) struct Changes {
    /// Memories that are new or have another layout; all their pages are stored.
    pub memories: Vec<Kept>,
    pub pages: Vec<Page>,
}

impl Changes {
    pub fn is_empty(&self) -> bool {
        self.memories.is_empty() && self.pages.is_empty()
    }
}

/// All that a file contains.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Image {
    memories: Vec<Kept>,
}

impl Kept {
    /// A memory of zeros.
    pub(super) fn new(name: &str, id: u16, layout: Layout) -> Kept {
        let areas = Area::ALL.map(|area| zeros(area, layout.span(area)));
        Kept { name: name.to_owned(), id, layout, areas }
    }

    pub(super) fn pages(&self) -> impl Iterator<Item = (u8, u16, &[u8])> {
        (0..).zip(&self.areas).flat_map(|(area, bytes)| {
            (0..).zip(bytes.chunks(PAGE)).map(move |(number, page)| (area, number, page))
        })
    }

    /// The contents for another layout: addresses that both have keep their items.
    pub(super) fn resized(&self, layout: Layout) -> [Box<[u8]>; 4] {
        Area::ALL.map(|area| {
            let (old, new) = (self.layout.span(area), layout.span(area));
            let from = &self.areas[area as usize];
            if old == new {
                return from.clone();
            }
            let mut bytes = zeros(area, new);
            if let Some((first, end)) = overlap(old, new) {
                let (at, to) = ((first - start(old)) as usize, (first - start(new)) as usize);
                copy(area, from, at, &mut bytes, to, (end - first) as usize);
            }
            bytes
        })
    }

    /// What another layout makes of the contents, in words; one sentence for each area that differs.
    pub(super) fn resizings(&self, layout: Layout) -> Vec<String> {
        let differing = Area::ALL.into_iter().filter(|&area| {
            let (old, new) = (self.layout.span(area), layout.span(area));
            old != new && (old.size() > 0 || new.size() > 0)
        });
        differing
            .map(|area| {
                let (old, new) = (self.layout.span(area), layout.span(area));
                let kept = match overlap(old, new) {
                    Some((first, end)) => format!("addresses {first}-{} are kept", end - 1),
                    None => "no address is kept".to_owned(),
                };
                let (name, old, new) = (area.name(), shown(old), shown(new));
                format!("{}: {name} had {old} and now has {new}: {kept}", self.name)
            })
            .collect()
    }
}

impl Image {
    pub fn new(memories: Vec<Kept>) -> Image {
        Image { memories }
    }

    pub fn memories(&self) -> &[Kept] {
        &self.memories
    }

    pub fn into_memories(self) -> Vec<Kept> {
        self.memories
    }

    pub fn named(&self, name: &str) -> Option<&Kept> {
        self.memories.iter().find(|kept| kept.name == name)
    }

    fn numbered(&self, id: u16) -> Option<&Kept> {
        self.memories.iter().find(|kept| kept.id == id)
    }

    /// The numbers that no memory has.
    pub fn free_ids(&self) -> impl Iterator<Item = u16> {
        (0..=u16::MAX).filter(|id| self.numbered(*id).is_none())
    }

    /// Whether a page is in the file as it is.
    pub fn has(&self, page: &Page) -> bool {
        let from = usize::from(page.number) * PAGE;
        self.numbered(page.memory).is_some_and(|kept| {
            kept.areas[usize::from(page.area)][from..from + page.bytes.len()] == *page.bytes
        })
    }

    pub fn apply(&mut self, changes: Changes) {
        for new in changes.memories {
            match self.memories.iter_mut().find(|kept| kept.id == new.id) {
                Some(kept) => *kept = new,
                None => self.memories.push(new),
            }
        }
        for page in changes.pages {
            let kept = self.memories.iter_mut().find(|kept| kept.id == page.memory);
            let Some(kept) = kept else { unreachable!("pages are of memories in the file") };
            let from = usize::from(page.number) * PAGE;
            let area = &mut kept.areas[usize::from(page.area)];
            area[from..from + page.bytes.len()].copy_from_slice(&page.bytes);
        }
    }

    /// The pages in which contents differ from those in the file.
    pub fn differing(&self, id: u16, contents: &Contents) -> Vec<Page> {
        let Some(kept) = self.numbered(id) else { return Vec::new() };
        let mut pages = Vec::new();
        for (area, (old, new)) in (0..).zip(kept.areas.iter().zip(&contents.areas)) {
            if old == new {
                continue;
            }
            for (number, (was, is)) in (0..).zip(old.chunks(PAGE).zip(new.chunks(PAGE))) {
                if was != is {
                    pages.push(Page { memory: id, area, number, bytes: is.to_vec() });
                }
            }
        }
        pages
    }
}

pub(super) fn layout_of(memory: &Memory) -> Layout {
    Area::ALL
        .into_iter()
        .fold(Layout::default(), |layout, area| layout.with(area, memory.span(area)))
}

/// The record of a memory: its number, and start and size of each area.
pub(super) fn encode(id: u16, layout: Layout) -> Vec<u8> {
    let mut record = id.to_be_bytes().to_vec();
    for area in Area::ALL {
        let span = layout.span(area);
        record.extend(span.start().to_be_bytes());
        record.extend(span.size().to_be_bytes());
    }
    record
}

/// # Errors
/// [`FileError::Damaged`]
pub(super) fn decode(name: &str, record: &[u8]) -> Result<Kept, FileError> {
    let invalid = || FileError::damaged(format!("the layout of memory {name} is invalid"));
    let (id, mut spans) = record.split_first_chunk().ok_or_else(invalid)?;
    let mut layout = Layout::default();
    for area in Area::ALL {
        let (start, rest) = spans.split_first_chunk().ok_or_else(invalid)?;
        let (size, rest) = rest.split_first_chunk().ok_or_else(invalid)?;
        let span = Span::new(u16::from_be_bytes(*start), u32::from_be_bytes(*size));
        layout = layout.with(area, span.map_err(|_| invalid())?);
        spans = rest;
    }
    if spans.is_empty() {
        Ok(Kept::new(name, u16::from_be_bytes(*id), layout))
    } else {
        Err(invalid())
    }
}

fn zeros(area: Area, span: Span) -> Box<[u8]> {
    vec![0; area.byte_len(span.size() as usize)].into_boxed_slice()
}

fn start(span: Span) -> u32 {
    span.start().into()
}

fn shown(span: Span) -> String {
    match span.size() {
        0 => "no addresses".to_owned(),
        _ => format!("addresses {}-{}", span.start(), span.end() - 1),
    }
}

/// The first address of both, and the address after the last one.
fn overlap(old: Span, new: Span) -> Option<(u32, u32)> {
    let (first, end) = (start(old).max(start(new)), old.end().min(new.end()));
    (first < end).then_some((first, end))
}

/// Copies items of an area.
fn copy(area: Area, from: &[u8], at: usize, into: &mut [u8], to: usize, count: usize) {
    if area.is_bits() {
        for index in 0..count {
            let (at, to) = (at + index, to + index);
            into[to / 8] |= (from[at / 8] >> (at % 8) & 1) << (to % 8);
        }
    } else {
        into[to * 2..(to + count) * 2].copy_from_slice(&from[at * 2..(at + count) * 2]);
    }
}
