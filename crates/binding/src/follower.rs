//! `Follower`: what has changed in ranges of a memory.

use std::sync::{Arc, Mutex};

use holdfast_memory::{Follower as CoreFollower, Refusal};
use holdfast_runtime::lock;
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::memory::{Memory, Range, Stale, integer};
use crate::python_values::listed;

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
        let looked = py.detach(|| lock(&self.core).changes());
        let (writes, changes) = looked.map_err(|refusal| match refusal {
            Refusal::Stale => Stale::new_err(refusal.to_string()),
            _ => PyOSError::new_err(refusal.to_string()),
        })?;
        let changes = changes.into_iter().map(|change| {
            let values = listed(py, change.area, change.count, &change.bytes)?;
            Ok((change.range, change.address, values))
        });
        Ok((writes, changes.collect::<PyResult<_>>()?))
    }
}
