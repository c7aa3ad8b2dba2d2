//! `Commands` and `ParsedWrites`: JSON commands in their plain form, which nearly all have: one object,
//! without escapes in its text, and integers as values.
//!
//! Nothing is refused here: what has another form, or can't be carried out, is handled as any other
//! request.

use std::collections::HashMap;
use std::sync::Mutex;

use bytes::Bytes;
use holdfast_engine::http::RequestHead;
use holdfast_memory::Area;
use holdfast_runtime::lock;
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::{PyBytes, PyString, PyTuple};
use serde::Deserialize;

use crate::batch::{Batch, Checked};
use crate::exchange::{HttpExchange, request};
use crate::memory::{Memory, largest, named, put};
use crate::peer;

/// What a source may write: the areas of each memory, and the most bytes of a command.
#[pyclass(frozen, module = "holdfast")]
pub struct Commands {
    targets: HashMap<String, Target>,
    most: usize,
}

/// A memory's name, its name in JSON, the memory, and the areas.
type Given<'py> = (Bound<'py, PyString>, Vec<u8>, Py<Memory>, Vec<String>);

struct Target {
    name: Py<PyString>,
    /// The name in JSON.
    shown: Bytes,
    memory: Py<Memory>,
    areas: Vec<Area>,
}

#[pymethods]
impl Commands {
    #[new]
    fn new(targets: Vec<Given<'_>>, most: usize) -> PyResult<Commands> {
        let targets = targets.into_iter().map(|(name, shown, memory, areas)| {
            let areas = areas.iter().map(|area| named(area)).collect::<PyResult<_>>()?;
            let key = name.to_str()?.to_owned();
            Ok((key, Target { name: name.unbind(), shown: shown.into(), memory, areas }))
        });
        Ok(Commands { targets: targets.collect::<PyResult<_>>()?, most })
    }
}

impl Commands {
    /// The memory's name, its name in JSON, and the write. `None` if the command has another form or is not granted,
    /// or its memory does not take it at once.
    pub fn parsed(&self, py: Python<'_>, body: &[u8]) -> Option<(Py<PyString>, Bytes, Batch)> {
        // An array could have the same values in the order of the fields.
        if body.len() > self.most || !body.trim_ascii_start().starts_with(b"{") {
            return None;
        }
        let Command { memory, area, address, values } = serde_json::from_slice(body).ok()?;
        let target = self.targets.get(memory)?;
        let area = target.areas.iter().copied().find(|known| known.name() == area)?;
        let (core, count) = (&target.memory.get().core, values.len());
        let is_there = core.span(area).holds(address, count);
        if !is_there || core.can_refuse_checked(area, address, count) {
            return None;
        }
        let mut bytes = vec![0; area.byte_len(count)];
        for (index, value) in values.into_iter().enumerate() {
            put(area, &mut bytes, index, (value <= largest(area)).then_some(value)?);
        }
        let memory = target.memory.clone_ref(py);
        let batch = Batch::of(Checked { memory, area, address, count }, bytes)?;
        Some((target.name.clone_ref(py), target.shown.clone(), batch))
    }
}

/// The write of a request.
pub struct ParsedWrite {
    pub exchange: HttpExchange,
    pub head: Box<RequestHead>,
    /// The head as the host knows it.
    pub known: Py<PyTuple>,
    pub body: Bytes,
    pub name: Py<PyString>,
    /// The name in JSON.
    pub shown: Bytes,
    pub batch: Batch,
}

/// Writes of several requests, which were checked.
#[pyclass(frozen, module = "holdfast")]
pub struct ParsedWrites {
    /// The function that carries them out.
    #[pyo3(get)]
    handler: Py<PyAny>,
    writes: Mutex<Writes>,
}

#[derive(Default)]
struct Writes {
    open: Vec<ParsedWrite>,
    /// Those that were carried out.
    done: Vec<ParsedWrite>,
}

impl ParsedWrites {
    pub fn new(handler: Py<PyAny>, open: Vec<ParsedWrite>) -> ParsedWrites {
        ParsedWrites { handler, writes: Mutex::new(Writes { open, done: Vec::new() }) }
    }
}

#[pymethods]
impl ParsedWrites {
    /// The lines of the audit log, without time and place in the chain. Each begins with `before`, the
    /// address of the peer, and `after`.
    fn lines<'py>(&self, py: Python<'py>, before: &[u8], after: &[u8]) -> Vec<Bound<'py, PyBytes>> {
        let writes = lock(&self.writes);
        let lines = writes.open.iter().map(|write| {
            let peer = peer::text(&write.head.peer);
            let origin = [before, b"\"", peer.as_bytes(), b"\"", after].concat();
            let lines = write.batch.records(&origin, &[&write.shown], "done", None);
            PyBytes::new(py, &lines.concat())
        });
        lines.collect()
    }

    /// Carries out the writes, one after the other. Returns the memory of each that was carried out, and
    /// the number of its values.
    fn write(&self, py: Python<'_>) -> Vec<(Py<PyString>, usize)> {
        let mut writes = lock(&self.writes);
        let mut written = Vec::with_capacity(writes.open.len());
        for write in std::mem::take(&mut writes.open) {
            match write.batch.carry_out(py) {
                Ok((count, _)) => {
                    written.push((write.name.clone_ref(py), count));
                    writes.done.push(write);
                }
                Err(_) => writes.open.push(write),
            }
        }
        written
    }

    /// Answers the requests whose writes were carried out.
    fn respond(
        &self,
        status: u16,
        headers: &Bound<'_, PyAny>,
        bodies: Vec<PyBackedBytes>,
    ) -> PyResult<()> {
        let done = std::mem::take(&mut lock(&self.writes).done);
        for (write, body) in done.iter().zip(bodies) {
            write.exchange.respond(status, headers, &body, false)?;
        }
        Ok(())
    }

    /// Takes the requests whose writes were not carried out, as those of other commands.
    fn requests<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyTuple>>> {
        let open = std::mem::take(&mut lock(&self.writes).open);
        let requests =
            open.into_iter().map(|ParsedWrite { exchange, head, known, body, .. }| {
                request(py, exchange, known.into_bound(py), &head, Some(body))
            });
        requests.collect()
    }
}

/// A command in its plain form.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Command<'a> {
    memory: &'a str,
    area: &'a str,
    address: u16,
    values: Vec<u16>,
}
