//! `Follower` and `WriteQueue`: what has changed in a memory, and what was written to it.

use std::sync::{Arc, Mutex, PoisonError};

use holdfast_memory::{Access, Follower as CoreFollower, WriteQueue as CoreQueue};
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::arguments::seconds;
use crate::memory::{Memory, Range, integer, listed};

#[pyclass(frozen, module = "holdfast")]
pub struct Follower {
    core: Mutex<CoreFollower>,
}

/// The index of a range, an address, and the values from there.
type Change<'py> = (usize, u16, Bound<'py, PyList>);

#[pymethods]
impl Follower {
    #[new]
    fn new(
        memory: PyRef<'_, Memory>,
        ranges: Vec<(String, Bound<'_, PyAny>, Bound<'_, PyAny>)>,
    ) -> PyResult<Follower> {
        let ranges = ranges.iter().map(|(area, address, count)| {
            Range::new(&memory.core, area, integer(address)?, integer(count)?)
        });
        let ranges = ranges.collect::<PyResult<Vec<Range>>>()?;
        let places = ranges.iter().map(|range| (range.area, range.address, range.count));
        let core = CoreFollower::new(Arc::clone(&memory.core), places)
            .map_err(|refused| ranges[refused.index].refused(&memory.core, refused.refusal))?;
        Ok(Follower { core: Mutex::new(core) })
    }

    fn changes<'py>(&self, py: Python<'py>) -> PyResult<(u64, Vec<Change<'py>>)> {
        let (writes, changes) =
            py.detach(|| self.core.lock().unwrap_or_else(PoisonError::into_inner).changes());
        let told = changes.into_iter().map(|change| {
            let values = listed(py, change.area, change.count, &change.bytes)?;
            Ok((change.range, change.address, values))
        });
        Ok((writes, told.collect::<PyResult<_>>()?))
    }
}

/// Area, address, values, and whether a Modbus client wrote them.
type Written<'py> = (&'static str, u16, Bound<'py, PyList>, bool);

#[pyclass(frozen, module = "holdfast")]
pub struct WriteQueue {
    core: Arc<CoreQueue>,
}

#[pymethods]
impl WriteQueue {
    #[new]
    #[pyo3(signature = (memory, *, clients_only=false))]
    fn new(py: Python<'_>, memory: PyRef<'_, Memory>, clients_only: bool) -> WriteQueue {
        let core = Arc::clone(&memory.core);
        WriteQueue { core: py.detach(|| core.observe(clients_only)) }
    }

    fn next<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Written<'py>>> {
        let timeout = seconds("timeout", timeout)?;
        let Some(written) = py.detach(|| self.core.next(timeout)) else { return Ok(None) };
        let values = listed(py, written.area, written.count, &written.bytes)?;
        let is_client = written.access == Access::Client;
        Ok(Some((written.area.name(), written.address, values, is_client)))
    }

    fn close(&self) {
        self.core.close();
    }

    #[getter]
    fn is_closed(&self) -> bool {
        self.core.is_closed()
    }

    #[getter]
    fn dropped(&self) -> u64 {
        self.core.dropped()
    }
}
