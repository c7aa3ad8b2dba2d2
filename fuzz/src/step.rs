//! A step as a file and a log hold it, for two memories.

use std::sync::Arc;

use holdfast_journal::encoding;
use holdfast_memory::{Access, Area, Layout, Memory, Refusal, Span};

/// The first address and the size of each area, for each memory.
const SPANS: [[(u16, u32); 4]; 2] =
    [[(0, 40), (7, 20), (100, 300), (0, 1)], [(0, 9), (0, 0), (65_530, 6), (3, 70)]];

/// What is decoded is encoded to the same bytes, and its memories can carry it out.
pub fn check(data: &[u8]) {
    let members = members();
    let Ok(step) = encoding::decode(data, &members) else { return };
    let mut bytes = Vec::new();
    encoding::encode(&step, &mut bytes);
    assert_eq!(bytes, data);
    if let Err(refused) = step.carry_out(&members) {
        // No memory is sealed.
        assert_eq!((step.access, refused.refusal), (Access::Restore, Refusal::Unsealed));
    }
}

/// The memories of a step.
pub(crate) fn members() -> [Arc<Memory>; 2] {
    SPANS.map(|spans| {
        let layout =
            Area::ALL.into_iter().zip(spans).fold(Layout::default(), |layout, (area, span)| {
                layout.with(area, Span::new(span.0, span.1).expect("a span within the addresses"))
            });
        let layout = layout.with(Area::File(4), Span::new(0, 30).expect("records of a file"));
        Arc::new(Memory::new(layout, None).expect("memory for a few items"))
    })
}
