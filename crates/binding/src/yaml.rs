//! The events of YAML text, for the reader of configurations.

use std::borrow::Cow;

use pyo3::prelude::*;
use saphyr_parser::{Event, Parser, ScalarStyle, ScanError, Span, Tag};

/// What an event is, its line and column from 1, the anchor it has or names, tag and text.
type Row = (&'static str, usize, usize, Option<usize>, Option<String>, Option<String>);

/// The events of one document, without its start and end; none of an empty one. Stops after `most`
/// values. `None` for text that is not YAML, has several documents, or nests deeper than 255.
#[pyfunction]
pub fn yaml_events(py: Python<'_>, text: &str, most: usize) -> Option<Vec<Row>> {
    py.detach(|| rows(text, most)).ok().flatten()
}

fn rows(text: &str, most: usize) -> Result<Option<Vec<Row>>, ScanError> {
    let (mut found, mut values, mut documents) = (Vec::new(), 0, 0);
    for event in Parser::new_from_str(text) {
        let (event, span) = event?;
        match event {
            Event::DocumentStart(_) => documents += 1,
            Event::Nothing | Event::StreamStart | Event::DocumentEnd | Event::StreamEnd => {}
            event => {
                values += usize::from(!matches!(event, Event::MappingEnd | Event::SequenceEnd));
                found.push(row(event, span));
            }
        }
        if documents > 1 {
            return Ok(None);
        }
        if values > most {
            break;
        }
    }
    Ok(Some(found))
}

fn row(event: Event<'_>, span: Span) -> Row {
    let (what, anchor, tag, text) = match event {
        Event::Scalar(text, ScalarStyle::Plain, anchor, tag) => ("plain", anchor, tag, Some(text)),
        Event::Scalar(text, _, anchor, tag) => ("quoted", anchor, tag, Some(text)),
        Event::SequenceStart(anchor, tag) => ("list", anchor, tag, None),
        Event::MappingStart(anchor, tag) => ("mapping", anchor, tag, None),
        Event::Alias(anchor) => ("alias", anchor, None, None),
        _ => ("end", 0, None, None),
    };
    let anchor = (anchor > 0).then_some(anchor);
    let tag = tag.map(|tag: Cow<'_, Tag>| format!("{}{}", tag.handle, tag.suffix));
    // A column counts from 0, a line from 1.
    (what, span.start.line(), span.start.col() + 1, anchor, tag, text.map(Cow::into_owned))
}
