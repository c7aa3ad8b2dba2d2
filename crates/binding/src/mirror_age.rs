//! `MirrorAge`: the age of the values that were read from a device into a range of memory.

use std::sync::Arc;

use holdfast_engine::poller::MirrorAge as Core;
use holdfast_runtime::suspend_aware_time;
use pyo3::prelude::*;

use crate::arguments::seconds;

#[pyclass(frozen, module = "holdfast._core")]
pub struct MirrorAge {
    pub core: Arc<Core>,
}

#[pymethods]
impl MirrorAge {
    #[new]
    #[pyo3(signature = (after, *, refuses, lease=None))]
    fn new(after: f64, refuses: bool, lease: Option<u64>) -> PyResult<MirrorAge> {
        let core = Core::new(suspend_aware_time, seconds("after", after)?, refuses, lease);
        Ok(MirrorAge { core: Arc::new(core) })
    }

    #[pyo3(signature = (after, *, refuses))]
    fn set(&self, after: f64, refuses: bool) -> PyResult<()> {
        self.core.set(seconds("after", after)?, refuses);
        Ok(())
    }

    #[getter]
    fn seconds(&self) -> Option<f64> {
        self.core.age().map(|age| age.as_secs_f64())
    }

    #[getter]
    fn stale_for(&self) -> Option<f64> {
        self.core.stale_for().map(|time| time.as_secs_f64())
    }
}
