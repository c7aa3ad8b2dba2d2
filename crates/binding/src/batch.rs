//! `Batch`: writes to several memories in one step, or reports the value that was refused.
//!
//! It first consumes all iterables, then checks all values. So the exception of an iterable takes
//! precedence over a refused value.

use holdfast_memory::{Access, Area, Memory as Core, Refused, Write};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::{PyBytes, PyList, PyString, PyTuple};

use crate::audit_fields;
use crate::batch_refusal::{refusal, refused};
use crate::ended_writes::Waiting;
use crate::memory::{Memory, Unfit, integer, is_sequence, item, put};

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

/// Writes that were checked: `write` carries them out in one step.
#[pyclass(frozen, module = "holdfast")]
pub struct Batch {
    writes: Vec<Checked>,
    /// The values of all writes.
    bytes: Vec<u8>,
    access: Access,
}

pub struct Checked {
    pub memory: Py<Memory>,
    pub area: Area,
    pub address: u16,
    pub count: usize,
}

#[pymethods]
impl Batch {
    #[new]
    fn new(writes: &Bound<'_, PyAny>) -> PyResult<Batch> {
        let writes: Vec<Pending<'_>> = (writes.try_iter()?.enumerate())
            .map(|(command, write)| Pending::new(command, &write?))
            .collect::<PyResult<_>>()?;
        let mut bytes = vec![0; writes.iter().map(Pending::byte_len).sum()];
        let mut rest = &mut bytes[..];
        for (command, write) in writes.iter().enumerate() {
            let (bytes, behind) = rest.split_at_mut(write.byte_len());
            write.pack(command, bytes)?;
            rest = behind;
        }
        let access = holdfast_memory::access_of(writes.iter().map(|write| write.restores));
        let writes = writes.into_iter().map(|Pending { memory, area, address, count, .. }| {
            Checked { memory: memory.unbind(), area, address, count }
        });
        Ok(Batch { writes: writes.collect(), bytes, access })
    }

    fn check(&self, py: Python<'_>) -> PyResult<()> {
        let checked = holdfast_memory::check_across(self.access, &self.packed());
        checked.map_err(|error| refused(py, error))
    }

    #[pyo3(signature = (origin, names, outcome, sequence=None))]
    fn lines<'py>(
        &self,
        py: Python<'py>,
        origin: &[u8],
        names: Vec<PyBackedBytes>,
        outcome: &str,
        sequence: Option<u64>,
    ) -> Vec<Bound<'py, PyBytes>> {
        let names: Vec<&[u8]> = names.iter().map(|name| &**name).collect();
        let lines = self.records(origin, &names, outcome, sequence);
        lines.iter().map(|line| PyBytes::new(py, line)).collect()
    }

    #[getter]
    fn can_be_refused(&self) -> bool {
        let can_refuse = |&Checked { ref memory, area, address, count }: &Checked| {
            memory.get().core.can_refuse_checked(area, address, count)
        };
        self.access == Access::Restore || self.writes.iter().any(can_refuse)
    }

    fn write(&self, py: Python<'_>) -> PyResult<(usize, Option<u64>)> {
        self.carry_out(py).map_err(|error| refused(py, error))
    }

    fn submit(&self, py: Python<'_>, ended: Py<PyAny>) {
        let (mut waiting, packed) = (Waiting::new(ended, self.count()), self.packed());
        let done = Box::new(move |outcome| waiting.end(outcome));
        py.detach(|| holdfast_memory::submit_across(self.access, &packed, done));
    }
}

impl Batch {
    /// One write; `None` if it is refused.
    pub fn of(write: Checked, bytes: Vec<u8>) -> Option<Batch> {
        let batch = Batch { writes: vec![write], bytes, access: Access::Ingest };
        holdfast_memory::check_across(batch.access, &batch.packed()).ok()?;
        Some(batch)
    }

    /// Returns the number of values, and the sequence of the step if a log has carried it out.
    pub fn carry_out(&self, py: Python<'_>) -> Result<(usize, Option<u64>), Refused> {
        let packed = self.packed();
        let sequence = py.detach(|| holdfast_memory::write_across(self.access, &packed))?;
        Ok((self.count(), sequence))
    }

    /// The number of values.
    fn count(&self) -> usize {
        self.writes.iter().map(|write| write.count).sum()
    }

    /// The lines of the audit log, without time and place in the chain.
    pub fn records(
        &self,
        origin: &[u8],
        names: &[&[u8]],
        outcome: &str,
        sequence: Option<u64>,
    ) -> Vec<Vec<u8>> {
        let writes = self.packed().into_iter().zip(names);
        writes
            .map(|((_, write), name)| audit_fields::line(origin, name, &write, outcome, sequence))
            .collect()
    }

    fn packed(&self) -> Vec<(&Core, Write<'_>)> {
        let mut rest = &self.bytes[..];
        let mut packed = Vec::with_capacity(self.writes.len());
        for &Checked { ref memory, area, address, count } in &self.writes {
            let (bytes, behind) = rest.split_at(area.byte_len(count));
            rest = behind;
            packed.push((&*memory.get().core, Write { area, address, count, bytes }));
        }
        packed
    }
}

impl<'py> Pending<'py> {
    fn new(command: usize, write: &Bound<'py, PyAny>) -> PyResult<Pending<'py>> {
        let ((memory, area, address), values, restores) = parts(write)?;
        let refuse = |reason| Err(refusal(write.py(), command, None, reason));
        let Some(area) = Area::from_name(area.to_str()?) else { return refuse("invalid_area") };
        let values = match values.cast_into_exact::<PyList>() {
            Ok(list) => list,
            Err(error) => match listed(&error.into_inner())? {
                Some(list) => list,
                None => return refuse("invalid_type"),
            },
        };
        let count = values.len();
        if count == 0 {
            return refuse("empty");
        }
        let span = memory.get().core.span(area);
        let address = u16::try_from(integer(&address)?).ok();
        let Some(address) = address.filter(|address| span.holds(*address, count)) else {
            return refuse("out_of_range");
        };
        Ok(Pending { memory, area, address, count, values, restores })
    }

    fn byte_len(&self) -> usize {
        self.area.byte_len(self.count)
    }

    /// Checks the values and packs them into `bytes`.
    fn pack(&self, command: usize, bytes: &mut [u8]) -> PyResult<()> {
        let Pending { area, count, ref values, .. } = *self;
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
            put(area, bytes, index, value);
        }
        Ok(())
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

/// Lists the items of an iterable. `None` if it is no sequence of values.
fn listed<'py>(values: &Bound<'py, PyAny>) -> PyResult<Option<Bound<'py, PyList>>> {
    if !is_sequence(values) {
        return Ok(None);
    }
    let Ok(items) = values.try_iter() else { return Ok(None) };
    let list = PyList::empty(values.py());
    for item in items {
        list.append(item?)?;
    }
    Ok(Some(list))
}
