//! What a file contains: memories, in pages.

use std::ops::Range;

use bytes::Buf;
use holdfast_memory::{Area, Contents, Layout, Span};

use super::error::FileError;

/// The number of bytes of a page: 128 registers or 2048 bits. One register costs little to store, and a
/// whole area has few pages.
pub(super) const PAGE_BYTES: usize = 256;

/// A memory as it is in the file, or what was cut from one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredMemory {
    pub name: String,
    /// Its number in the file.
    pub(super) id: u16,
    pub layout: Layout,
    /// The bytes of its areas and files, as those of [`Contents`].
    pub areas: Vec<Box<[u8]>>,
}

/// A page to store.
#[derive(Debug, Clone)]
pub(super) struct Page {
    pub memory: u16,
    /// The index of the area, see [`Contents::areas`].
    pub area: usize,
    pub number: usize,
    pub bytes: Vec<u8>,
}

/// The key of a page in the file. The files of a memory may have more pages than its number has values: page numbers
/// above 65535 continue in the next area number.
pub(super) fn page_key(memory: u16, area: usize, number: usize) -> (u16, u8, u16) {
    (memory, (area + (number >> u16::BITS)) as u8, number as u16)
}

/// What a transaction changes.
#[derive(Debug, Default)]
pub(super) struct Changes {
    /// Memories that are new or have another layout; all their pages are stored.
    pub memories: Vec<StoredMemory>,
    pub pages: Vec<Page>,
    /// The names and numbers of what the file does not contain any more.
    pub removed: Vec<(String, u16)>,
    pub note: NoteChange,
}

/// What becomes of the note of the log.
#[derive(Debug, Default)]
pub(super) enum NoteChange {
    #[default]
    Keep,
    Set(Vec<u8>),
    Remove,
}

impl Changes {
    pub fn is_empty(&self) -> bool {
        self.memories.is_empty()
            && self.pages.is_empty()
            && self.removed.is_empty()
            && matches!(self.note, NoteChange::Keep)
    }
}

/// All that a file contains.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Image {
    pub memories: Vec<StoredMemory>,
    /// What the log has noted that the contents come from.
    pub note: Option<Vec<u8>>,
}

impl StoredMemory {
    /// A memory of zeros.
    pub(super) fn new(name: &str, id: u16, layout: Layout) -> StoredMemory {
        let areas = zeros(&layout);
        StoredMemory { name: name.to_owned(), id, layout, areas }
    }

    /// The bytes of an area or a file.
    pub fn bytes_of(&self, area: Area) -> &[u8] {
        place_of(area, &self.layout).map_or(&[], |(index, bytes)| &self.areas[index][bytes])
    }

    /// The index of the area, the number and the bytes of each page.
    pub(super) fn pages(&self) -> impl Iterator<Item = (usize, usize, &[u8])> {
        (0..).zip(&self.areas).flat_map(|(area, bytes)| {
            (0..).zip(bytes.chunks(PAGE_BYTES)).map(move |(number, page)| (area, number, page))
        })
    }

    /// The contents for another layout: addresses that both have keep their items.
    pub(super) fn resized(&self, layout: &Layout) -> Vec<Box<[u8]>> {
        if self.layout == *layout {
            return self.areas.clone();
        }
        let mut areas = zeros(layout);
        self.copy_into(&mut areas, layout);
        areas
    }

    /// Copies the items of the addresses that another layout has too.
    pub(super) fn copy_into(&self, areas: &mut [Box<[u8]>], layout: &Layout) {
        for area in layout.areas() {
            if let Some((index, bytes)) = place_of(area, layout) {
                let (old, new) = (self.layout.span(area), layout.span(area));
                copy_shared(area, self.bytes_of(area), old, &mut areas[index][bytes], new);
            }
        }
    }
}

impl Image {
    pub fn named(&self, name: &str) -> Option<&StoredMemory> {
        self.memories.iter().find(|stored| stored.name == name)
    }

    fn numbered(&self, id: u16) -> Option<&StoredMemory> {
        self.memories.iter().find(|stored| stored.id == id)
    }

    /// The numbers that no memory has.
    pub fn free_ids(&self) -> impl Iterator<Item = u16> {
        (0..=u16::MAX).filter(|id| self.numbered(*id).is_none())
    }

    /// Whether a page is in the file as it is.
    pub fn has(&self, page: &Page) -> bool {
        let from = page.number * PAGE_BYTES;
        self.numbered(page.memory).is_some_and(|stored| {
            stored.areas[page.area][from..from + page.bytes.len()] == *page.bytes
        })
    }

    pub fn apply(&mut self, changes: Changes) {
        self.memories.retain(|stored| changes.removed.iter().all(|(name, _)| *name != stored.name));
        match changes.note {
            NoteChange::Keep => {}
            NoteChange::Set(note) => self.note = Some(note),
            NoteChange::Remove => self.note = None,
        }
        for new in changes.memories {
            match self.memories.iter_mut().find(|stored| stored.id == new.id) {
                Some(stored) => *stored = new,
                None => self.memories.push(new),
            }
        }
        for page in changes.pages {
            let stored = self.memories.iter_mut().find(|stored| stored.id == page.memory);
            let Some(stored) = stored else { unreachable!("pages are of memories in the file") };
            let from = page.number * PAGE_BYTES;
            let area = &mut stored.areas[page.area];
            area[from..from + page.bytes.len()].copy_from_slice(&page.bytes);
        }
    }

    /// The pages in which contents differ from those in the file.
    pub fn differing(&self, id: u16, contents: &Contents) -> Vec<Page> {
        let Some(stored) = self.numbered(id) else { return Vec::new() };
        let mut pages = Vec::new();
        for (area, (old, new)) in (0..).zip(stored.areas.iter().zip(&contents.areas)) {
            if old == new {
                continue;
            }
            for (number, (was, is)) in (0..).zip(old.chunks(PAGE_BYTES).zip(new.chunks(PAGE_BYTES)))
            {
                if was != is {
                    pages.push(Page { memory: id, area, number, bytes: is.to_vec() });
                }
            }
        }
        pages
    }
}

/// The record of a memory: its number, start and size of each area, and number, start and size of each
/// file.
pub(super) fn encode(id: u16, layout: &Layout) -> Vec<u8> {
    let mut record = id.to_be_bytes().to_vec();
    for area in layout.areas() {
        let span = layout.span(area);
        if let Area::File(number) = area {
            record.extend(number.to_be_bytes());
        }
        record.extend(span.start().to_be_bytes());
        record.extend(span.size().to_be_bytes());
    }
    record
}

/// # Errors
/// [`FileError::Damaged`]
pub(super) fn decode(name: &str, record: &[u8]) -> Result<StoredMemory, FileError> {
    let invalid = || FileError::damaged(format!("the layout of memory {name} is invalid"));
    let mut rest = record;
    let id = rest.try_get_u16().map_err(|_| invalid())?;
    let (mut layout, mut areas, mut last) = (Layout::default(), Area::ALL.into_iter(), 0);
    loop {
        let area = match areas.next() {
            Some(area) => area,
            None if rest.is_empty() => break,
            None => {
                let number = rest.try_get_u16().map_err(|_| invalid())?;
                if number <= last {
                    return Err(invalid());
                }
                last = number;
                Area::File(number)
            }
        };
        let start = rest.try_get_u16().map_err(|_| invalid())?;
        let size = rest.try_get_u32().map_err(|_| invalid())?;
        layout = layout.with(area, Span::new(start, size).map_err(|_| invalid())?);
    }
    Ok(StoredMemory::new(name, id, layout))
}

fn zeros(layout: &Layout) -> Vec<Box<[u8]>> {
    layout.byte_lens().into_iter().map(|len| vec![0; len].into_boxed_slice()).collect()
}

/// Where the bytes of a whole area or file are.
fn place_of(area: Area, layout: &Layout) -> Option<(usize, Range<usize>)> {
    let span = layout.span(area);
    layout.bytes(area, span.start(), span.size() as usize)
}

pub(super) fn start(span: Span) -> u32 {
    span.start().into()
}

/// The first address of both, and the address after the last one.
pub(super) fn overlap(old: Span, new: Span) -> Option<(u32, u32)> {
    let (first, end) = (start(old).max(start(new)), old.end().min(new.end()));
    (first < end).then_some((first, end))
}

/// Copies the items of the addresses that two spans share.
pub(super) fn copy_shared(area: Area, from: &[u8], old: Span, into: &mut [u8], new: Span) {
    if let Some((first, end)) = overlap(old, new) {
        let (at, to) = ((first - start(old)) as usize, (first - start(new)) as usize);
        area.copy(from, at, into, to, (end - first) as usize);
    }
}
