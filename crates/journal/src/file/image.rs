//! What a file contains: memories, in pages.

use holdfast_memory::{Area, Contents, Layout, Memory, Span};

use super::error::FileError;

/// The number of bytes of a page: 128 registers or 2048 bits. One register costs little to store, and a
/// whole area has few pages.
pub(super) const PAGE_BYTES: usize = 256;

/// Ends the name of a record with what was cut from a memory. Names of memories have no colon.
pub(super) const SET_ASIDE: &str = ":set-aside";

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

    /// The memory that this was cut from; `None` if this is a memory.
    pub fn set_aside_of(&self) -> Option<&str> {
        self.name.strip_suffix(SET_ASIDE)
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

    /// This memory, and around it what was cut from it. Addresses between the two have zeros.
    pub(super) fn with(&self, set_aside: Option<&StoredMemory>) -> StoredMemory {
        let Some(set_aside) = set_aside else { return self.clone() };
        let mut layout = self.layout;
        for area in Area::ALL {
            layout = layout.with(area, around(self.layout.span(area), set_aside.layout.span(area)));
        }
        let mut areas = set_aside.resized(layout);
        for (area, bytes) in Area::ALL.into_iter().zip(&mut areas) {
            let from = &self.areas[area as usize];
            copy_shared(area, from, self.layout.span(area), bytes, layout.span(area));
        }
        StoredMemory { name: self.name.clone(), id: self.id, layout, areas }
    }

    /// What is set aside when the memory has another layout; `None` if that lacks nothing. Addresses
    /// that it has are 0 in between.
    pub(super) fn cut(
        &self,
        set_aside: Option<&StoredMemory>,
        other: Layout,
        id: u16,
    ) -> Option<StoredMemory> {
        let mut layout = Layout::default();
        for area in Area::ALL {
            layout = layout.with(area, self.lacking(set_aside, other, area));
        }
        if Area::ALL.iter().all(|area| layout.span(*area).size() == 0) {
            return None;
        }
        let mut areas = self.with(set_aside).resized(layout);
        for (area, bytes) in Area::ALL.into_iter().zip(&mut areas) {
            let has = other.span(area);
            copy_shared(area, &zeros(area, has), has, bytes, layout.span(area));
        }
        Some(StoredMemory { name: format!("{}{SET_ASIDE}", self.name), id, layout, areas })
    }

    /// The addresses that another layout lacks, of those that are known; perhaps with some of its own
    /// in between.
    fn lacking(&self, set_aside: Option<&StoredMemory>, other: Layout, area: Area) -> Span {
        let known = [Some(self), set_aside].into_iter().flatten();
        let lacking = known.flat_map(|stored| outside(stored.layout.span(area), other.span(area)));
        lacking.fold(Span::default(), around)
    }

    /// What another layout makes of the contents, in words; one sentence for each area that differs,
    /// and one for all that is set aside afterwards.
    pub(super) fn resizings(
        &self,
        set_aside: Option<&StoredMemory>,
        layout: Layout,
    ) -> Vec<String> {
        let name = &self.name;
        let (mut sentences, mut lacking) = (Vec::new(), Vec::new());
        for area in Area::ALL {
            let (old, new) = (self.layout.span(area), layout.span(area));
            let spans = outside(self.lacking(set_aside, layout, area), new);
            if !spans.is_empty() {
                lacking.push(format!("{} {}", area.name(), listed(&spans)));
            }
            if old == new || (old.size() == 0 && new.size() == 0) {
                continue;
            }
            let mut parts = vec![match overlap(old, new) {
                Some((first, end)) => format!("addresses {first}-{} are kept", end - 1),
                None => "no address is kept".to_owned(),
            }];
            let aside = set_aside.map_or(Span::default(), |stored| stored.layout.span(area));
            let back = outside(new, old).into_iter().filter_map(|new| overlap(new, aside));
            let back: Vec<_> = back.map(|(first, end)| span(first, end)).collect();
            for (spans, what) in [(back, "back"), (outside(old, new), "set aside")] {
                if !spans.is_empty() {
                    parts.push(format!("addresses {} are {what}", listed(&spans)));
                }
            }
            let (area, parts) = (area.name(), parts.join(", "));
            let (old, new) = (shown(old), shown(new));
            sentences.push(format!("{name}: {area} had {old} and now has {new}: {parts}"));
        }
        if !lacking.is_empty() {
            let lacking = lacking.join(", ");
            sentences.push(format!(
                "{name}: set aside in the file: {lacking}. Their values come back when the memory \
                 has these addresses again; 'holdfast memory release' deletes them"
            ));
        }
        sentences
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

    /// What was cut from a memory.
    pub fn set_aside_of(&self, name: &str) -> Option<&StoredMemory> {
        self.memories.iter().find(|stored| stored.set_aside_of() == Some(name))
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

fn span(first: u32, end: u32) -> Span {
    let span = u16::try_from(first).ok().and_then(|start| Span::new(start, end - first).ok());
    span.expect("it is between the addresses of other spans")
}

/// The shortest span with the addresses of both.
fn around(one: Span, other: Span) -> Span {
    match (one.size(), other.size()) {
        (_, 0) => one,
        (0, _) => other,
        _ => span(start(one).min(start(other)), one.end().max(other.end())),
    }
}

/// The addresses of one span that another one lacks: none, or those below and above it.
fn outside(one: Span, other: Span) -> Vec<Span> {
    if one.size() == 0 || other.size() == 0 {
        return if one.size() == 0 { Vec::new() } else { vec![one] };
    }
    let below = (start(one), one.end().min(start(other)));
    let above = (start(one).max(other.end()), one.end());
    let parts = [below, above].into_iter().filter(|(first, end)| first < end);
    parts.map(|(first, end)| span(first, end)).collect()
}

fn listed(spans: &[Span]) -> String {
    let texts = spans.iter().map(|span| format!("{}-{}", span.start(), span.end() - 1));
    texts.collect::<Vec<_>>().join(" and ")
}

/// Copies the items of the addresses that two spans share.
fn copy_shared(area: Area, from: &[u8], old: Span, into: &mut [u8], new: Span) {
    if let Some((first, end)) = overlap(old, new) {
        let (at, to) = ((first - start(old)) as usize, (first - start(new)) as usize);
        copy(area, from, at, into, to, (end - first) as usize);
    }
}

/// Copies items of an area.
fn copy(area: Area, from: &[u8], at: usize, into: &mut [u8], to: usize, count: usize) {
    if area.is_bits() {
        for index in 0..count {
            let (at, to) = (at + index, to + index);
            let (bit, mask) = (from[at / 8] >> (at % 8) & 1, 1 << (to % 8));
            into[to / 8] = into[to / 8] & !mask | bit << (to % 8);
        }
    } else {
        into[to * 2..(to + count) * 2].copy_from_slice(&from[at * 2..(at + count) * 2]);
    }
}
