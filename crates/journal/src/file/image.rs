//! What a file contains: memories, in pages.

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
    pub memories: Vec<StoredMemory>,
    pub pages: Vec<Page>,
    /// The names and numbers of what the file does not contain any more.
    pub removed: Vec<(String, u16)>,
    /// Another note of the log, or none any more.
    pub note: Option<Option<Vec<u8>>>,
}

impl Changes {
    pub fn is_empty(&self) -> bool {
        self.memories.is_empty()
            && self.pages.is_empty()
            && self.removed.is_empty()
            && self.note.is_none()
    }
}

/// All that a file contains.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Image {
    memories: Vec<StoredMemory>,
    note: Option<Vec<u8>>,
}

impl StoredMemory {
    /// A memory of zeros.
    pub(super) fn new(name: &str, id: u16, layout: Layout) -> StoredMemory {
        let areas = Area::ALL.map(|area| zeros(area, layout.span(area)));
        StoredMemory { name: name.to_owned(), id, layout, areas }
    }

    pub(super) fn pages(&self) -> impl Iterator<Item = (u8, u16, &[u8])> {
        (0..).zip(&self.areas).flat_map(|(area, bytes)| {
            (0..).zip(bytes.chunks(PAGE_BYTES)).map(move |(number, page)| (area, number, page))
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
            copy_shared(area, from, old, &mut bytes, new);
            bytes
        })
    }
}

impl Image {
    pub fn new(memories: Vec<StoredMemory>, note: Option<Vec<u8>>) -> Image {
        Image { memories, note }
    }

    /// What the log has noted that the contents come from.
    pub fn note(&self) -> Option<&Vec<u8>> {
        self.note.as_ref()
    }

    pub fn memories(&self) -> &[StoredMemory] {
        &self.memories
    }

    pub fn into_memories(self) -> Vec<StoredMemory> {
        self.memories
    }

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
        let from = usize::from(page.number) * PAGE_BYTES;
        self.numbered(page.memory).is_some_and(|stored| {
            stored.areas[usize::from(page.area)][from..from + page.bytes.len()] == *page.bytes
        })
    }

    pub fn apply(&mut self, changes: Changes) {
        self.memories.retain(|stored| changes.removed.iter().all(|(name, _)| *name != stored.name));
        if let Some(note) = changes.note {
            self.note = note;
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
            let from = usize::from(page.number) * PAGE_BYTES;
            let area = &mut stored.areas[usize::from(page.area)];
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
pub(super) fn decode(name: &str, record: &[u8]) -> Result<StoredMemory, FileError> {
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
        Ok(StoredMemory::new(name, u16::from_be_bytes(*id), layout))
    } else {
        Err(invalid())
    }
}

pub(super) fn zeros(area: Area, span: Span) -> Box<[u8]> {
    vec![0; area.byte_len(span.size() as usize)].into_boxed_slice()
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
