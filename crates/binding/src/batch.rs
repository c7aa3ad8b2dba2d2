//! `write_across`: writes a batch to several memories, or reports the value that was refused.
//!
//! It first consumes all iterables, then checks all values, then calls `before`, then writes. So an
//! iterable that raises has changed nothing, and its exception takes precedence over a refused value.

use holdfast_memory::{Access, Area, Memory as Core, Refusal, Refused, Write};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyList, PyString, PyTuple};

use crate::memory::{Memory, Unfit, integer, is_text, item};

pyo3::create_exception!(
    holdfast._core,
    BatchRefused,
    PyValueError,
    "A write of a batch was refused."
);

/// A write with a valid range. Its values are not checked yet.
struct Pending<'py> {
    memory: Bound<'py, Memory>,
    area: Area,
    address: u16,
    count: usize,
    values: Bound<'py, PyList>,
    /// Whether it is granted only while the memory is sealed.
    restores: bool,
}

type Place<'py> = (Bound<'py, Memory>, Bound<'py, PyString>, Bound<'py, PyAny>);

/// Writes to several memories atomically. Returns the number of values written, and the sequence of the
/// step if a log has carried it out. `before` receives whether the writes can still be refused: by a
/// journal, or because a memory is not sealed.
#[pyfunction]
#[pyo3(signature = (writes, before=None))]
pub fn write_across(
    py: Python<'_>,
    writes: &Bound<'_, PyAny>,
    before: Option<&Bound<'_, PyAny>>,
) -> PyResult<(usize, Option<u64>)> {
    let (mut pending, mut len) = (Vec::new(), 0);
    for (command, write) in writes.try_iter()?.enumerate() {
        let write = Pending::new(command, &write?)?;
        len += write.area.byte_len(write.count);
        pending.push(write);
    }
    let mut bytes = vec![0; len];
    let mut rest = &mut bytes[..];
    let mut packed: Vec<(&Core, Write)> = Vec::with_capacity(pending.len());
    for (command, write) in pending.iter().enumerate() {
        let (bytes, behind) = rest.split_at_mut(write.area.byte_len(write.count));
        rest = behind;
        packed.push((&write.memory.get().core, write.packed(command, bytes)?));
    }
    let refused = |refused: Refused| refusal(py, refused.index, None, reason(refused.refusal));
    // A batch is one step, so one write that requires a seal requires it of all memories.
    let restores = pending.iter().any(|write| write.restores);
    let access = if restores { Access::Restore } else { Access::Ingest };
    if let Some(before) = before {
        holdfast_memory::check_across(access, &packed).map_err(refused)?;
        before.call1((restores || packed.iter().any(|(memory, _)| memory.has_journal()),))?;
    }
    let sequence = py.detach(|| holdfast_memory::write_across(access, &packed));
    Ok((pending.iter().map(|write| write.count).sum(), sequence.map_err(refused)?))
}

impl<'py> Pending<'py> {
    fn new(command: usize, write: &Bound<'py, PyAny>) -> PyResult<Pending<'py>> {
        let ((memory, area, address), values, restores) = parts(write)?;
        let refused = |reason| Err(refusal(write.py(), command, None, reason));
        let Some(area) = Area::from_name(area.to_str()?) else { return refused("invalid_area") };
        let values = match values.cast_into_exact::<PyList>() {
            Ok(list) => list,
            Err(error) => match listed(&error.into_inner())? {
                Some(list) => list,
                None => return refused("invalid_type"),
            },
        };
        let count = values.len();
        if count == 0 {
            return refused("empty");
        }
        let span = memory.get().core.span(area);
        let address = u16::try_from(integer(&address)?).ok();
        let Some(address) = address.filter(|address| span.holds(*address, count)) else {
            return refused("out_of_range");
        };
        Ok(Pending { memory, area, address, count, values, restores })
    }

    /// Checks the values and packs them into `bytes`.
    fn packed<'b>(&self, command: usize, bytes: &'b mut [u8]) -> PyResult<Write<'b>> {
        let Pending { area, address, count, ref values, .. } = *self;
        if values.len() != count {
            return Err(PyRuntimeError::new_err("values changed while they were read"));
        }
        for index in 0..count {
            let value = item(area, &values.get_item(index)?).map_err(|unfit| {
                let reason = match unfit {
                    Unfit::Value => "invalid_value",
                    Unfit::Type => "invalid_type",
                };
                refusal(values.py(), command, Some(index), reason)
            })?;
            if area.is_bits() {
                bytes[index / 8] |= (value as u8) << (index % 8);
            } else {
                bytes[index * 2..index * 2 + 2].copy_from_slice(&value.to_be_bytes());
            }
        }
        Ok(Write { area, address, count, bytes })
    }
}

/// The parts of a write. The last one can be left out.
fn parts<'py>(write: &Bound<'py, PyAny>) -> PyResult<(Place<'py>, Bound<'py, PyAny>, bool)> {
    if write.cast::<PyTuple>()?.len() == 5 {
        let (memory, area, address, values, restores) = write.extract()?;
        return Ok(((memory, area, address), values, restores));
    }
    let (memory, area, address, values) = write.extract()?;
    Ok(((memory, area, address), values, false))
}

/// Lists the items of an iterable. `None` if it is not iterable, or is text or bytes.
fn listed<'py>(values: &Bound<'py, PyAny>) -> PyResult<Option<Bound<'py, PyList>>> {
    if is_text(values) {
        return Ok(None);
    }
    let Ok(items) = values.try_iter() else { return Ok(None) };
    let list = PyList::empty(values.py());
    for item in items {
        list.append(item?)?;
    }
    Ok(Some(list))
}

fn refusal(py: Python<'_>, command: usize, index: Option<usize>, reason: &'static str) -> PyErr {
    let place = index.map_or_else(String::new, |index| format!("values[{index}]: "));
    let error = BatchRefused::new_err(format!("writes[{command}]: {place}{reason}"));
    let value = error.value(py);
    let noted = value
        .setattr("command", command)
        .and_then(|()| value.setattr("index", index))
        .and_then(|()| value.setattr("reason", reason));
    noted.err().unwrap_or(error)
}

const fn reason(refusal: Refusal) -> &'static str {
    match refusal {
        Refusal::Sealed => "sealed",
        Refusal::Unsealed => "unsealed",
        Refusal::OutOfRange => "out_of_range",
        Refusal::GateBit => "gate_bit",
        Refusal::WrongLength => "wrong_length",
        Refusal::Mirrored => "mirrored",
        Refusal::Stale => "stale",
        Refusal::NotRegisters => "not_registers",
        // What is wrong with the log is in its status.
        Refusal::Unavailable | Refusal::Behind | Refusal::Differs => "log_unavailable",
        Refusal::NotStored => "not_stored",
        Refusal::NotConfirmed => "not_confirmed",
        Refusal::NotOneStep => "not_one_step",
    }
}
