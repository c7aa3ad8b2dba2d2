//! `Fence`: stops the use of devices when the lease of this node ends.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holdfast_engine::link::{Fence as Core, Stage};
use holdfast_memory::Term;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;

use crate::arguments::seconds;

#[pyclass(frozen, module = "holdfast")]
pub struct Fence {
    pub(crate) core: Arc<Core>,
}

#[pymethods]
impl Fence {
    #[new]
    fn new(lease: u64) -> Fence {
        Fence { core: Arc::new(Core::new(lease)) }
    }

    #[pyo3(signature = (until, *, term=(0, 0), settle=0.0))]
    fn open(&self, py: Python<'_>, until: f64, term: (u64, u64), settle: f64) -> PyResult<()> {
        let settle = seconds("settle", settle)?;
        let term = Term { epoch: term.0, since: term.1 };
        self.core.open(instant(py, until)?, term, settle);
        Ok(())
    }

    fn renew(&self, py: Python<'_>, until: f64) -> PyResult<()> {
        self.core.renew(instant(py, until)?);
        Ok(())
    }

    fn end(&self) {
        self.core.end();
    }

    fn close(&self) {
        self.core.close();
    }

    #[getter]
    fn is_open(&self) -> bool {
        self.core.stage() == Stage::Open
    }

    #[getter]
    fn allows(&self) -> bool {
        self.core.allows()
    }

    #[getter]
    fn in_use(&self) -> usize {
        self.core.in_use()
    }
}

/// Times further ahead count as this one: `Duration::from_secs_f64` panics for large numbers.
/// Leases are renewed far more often.
const MAX_AHEAD_S: f64 = 3600.0;

/// A time of Python's `time.monotonic`, at most `MAX_AHEAD_S` ahead; now if it has passed.
///
/// Rust's clock is read first: if the process is stopped in between, the result is too early, never
/// too late.
fn instant(py: Python<'_>, time: f64) -> PyResult<Instant> {
    static CLOCK: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let now = Instant::now();
    let clock = CLOCK.import(py, "time", "monotonic")?;
    let left = time - clock.call0()?.extract::<f64>()?;
    if left.is_nan() {
        return Err(PyValueError::new_err("until is NaN, allowed: a time of time.monotonic"));
    }
    Ok(now + Duration::from_secs_f64(left.clamp(0.0, MAX_AHEAD_S)))
}
