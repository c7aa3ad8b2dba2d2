//! What is set aside when a memory becomes smaller: values at addresses that it does not have any more.
//! They come back when it has these addresses again.

use std::collections::BTreeSet;
use std::sync::Arc;

use holdfast_memory::{Area, Layout, Span};

use super::disk::Disk;
use super::error::FileError;
use super::image::{Changes, Image, StoredMemory, overlap, start};
use super::store::Store;

/// Ends the name of a record with what was cut from a memory. Names of memories have no colon.
pub(super) const SET_ASIDE: &str = ":set-aside";

impl StoredMemory {
    /// The memory that this was cut from; `None` if this is a memory.
    pub fn set_aside_of(&self) -> Option<&str> {
        self.name.strip_suffix(SET_ASIDE)
    }

    /// This memory, and around it what was cut from it. Addresses between the two have zeros.
    pub(super) fn with(&self, set_aside: Option<&StoredMemory>) -> StoredMemory {
        let Some(set_aside) = set_aside else { return self.clone() };
        let mut layout = self.layout.clone();
        for area in set_aside.layout.areas() {
            layout = layout.with(area, around(self.layout.span(area), set_aside.layout.span(area)));
        }
        let mut areas = set_aside.resized(&layout);
        self.copy_into(&mut areas, &layout);
        StoredMemory { name: self.name.clone(), id: self.id, layout, areas }
    }

    /// The layout and contents of what is set aside when the memory has another layout; `None` if that lacks
    /// nothing. Addresses that it has are 0 in between.
    pub(super) fn cut(
        &self,
        set_aside: Option<&StoredMemory>,
        other: &Layout,
    ) -> Option<(Layout, Vec<Box<[u8]>>)> {
        let mut layout = Layout::default();
        for area in self.known(set_aside) {
            layout = layout.with(area, self.lacking(set_aside, other, area));
        }
        if layout.areas().all(|area| layout.span(area).size() == 0) {
            return None;
        }
        let mut areas = self.with(set_aside).resized(&layout);
        StoredMemory::new("", 0, other.clone()).copy_into(&mut areas, &layout);
        Some((layout, areas))
    }

    /// The areas, and the files that are known.
    fn known(&self, set_aside: Option<&StoredMemory>) -> BTreeSet<Area> {
        let stored = [Some(self), set_aside].into_iter().flatten();
        stored.flat_map(|stored| stored.layout.areas()).collect()
    }

    /// The addresses that another layout lacks, of those that are known; perhaps with some of its own
    /// in between.
    fn lacking(&self, set_aside: Option<&StoredMemory>, other: &Layout, area: Area) -> Span {
        let stored = [Some(self), set_aside].into_iter().flatten();
        let lacking = stored.flat_map(|stored| outside(stored.layout.span(area), other.span(area)));
        lacking.fold(Span::default(), around)
    }

    /// What another layout makes of the contents, in words; one sentence for each area that differs,
    /// and one for all that is set aside afterwards.
    pub(super) fn resizings(
        &self,
        set_aside: Option<&StoredMemory>,
        layout: &Layout,
    ) -> Vec<String> {
        let name = &self.name;
        let (mut sentences, mut lacking) = (Vec::new(), Vec::new());
        let mut known = self.known(set_aside);
        known.extend(layout.areas());
        for area in known {
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
    /// What was cut from a memory.
    pub fn set_aside_of(&self, name: &str) -> Option<&StoredMemory> {
        self.memories.iter().find(|stored| stored.set_aside_of() == Some(name))
    }
}

/// Deletes what was cut from a memory and set aside in the file. Returns whether there was anything.
///
/// # Errors
/// As [`read`](super::read).
pub fn release(disk: Arc<dyn Disk>, memory: &str) -> Result<bool, FileError> {
    if disk.size()?.is_none() {
        return Err(FileError::Io(std::io::ErrorKind::NotFound.into()));
    }
    let mut store = Store::open(disk, Arc::default())?;
    let set_aside = store.image().set_aside_of(memory);
    let removed: Vec<_> =
        set_aside.map(|stored| (stored.name.clone(), stored.id)).into_iter().collect();
    let was = !removed.is_empty();
    store.store(Changes { removed, ..Changes::default() })?;
    store.close()?;
    Ok(was)
}

fn shown(span: Span) -> String {
    match span.size() {
        0 => "no addresses".to_owned(),
        _ => format!("addresses {}-{}", span.start(), span.end() - 1),
    }
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
