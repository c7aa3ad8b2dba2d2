//! `WriteQueue`: the writes to a memory.

use std::borrow::Cow;
use std::sync::Arc;

use holdfast_memory::WriteQueue as CoreQueue;
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::arguments::seconds;
use crate::python_values::listed;

/// Area, address, values.
type Written<'py> = (Cow<'static, str>, u16, Bound<'py, PyList>);

#[pyclass(frozen, module = "holdfast")]
pub struct WriteQueue {
    pub core: Arc<CoreQueue>,
}

#[pymethods]
impl WriteQueue {
    fn next<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Written<'py>>> {
        let timeout = seconds("timeout", timeout)?;
        let Some(written) = py.detach(|| self.core.next(timeout)) else { return Ok(None) };
        let values = listed(py, written.area, written.count, &written.bytes)?;
        Ok(Some((written.area.name(), written.address, values)))
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
