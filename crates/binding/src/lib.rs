//! `holdfast._core`: the native parts as Python sees them.
//!
//! This crate converts and forwards, and holds no logic. The interpreter is released around
//! everything that can wait.

mod arguments;
mod audit;
mod client;
mod connection;
mod engine;
mod listener;
mod memory;
mod poller;

use pyo3::prelude::*;

#[pymodule(gil_used = false)]
mod _core {
    use super::{Bound, PyModule, PyModuleMethods, PyResult};

    #[pymodule_export]
    use super::client::{BlockingClient, Endpoint, Request};
    #[pymodule_export]
    use super::connection::Connection;
    #[pymodule_export]
    use super::engine::Engine;
    #[pymodule_export]
    use super::listener::{Listener, RawRule, Rule, ServerTls};
    #[pymodule_export]
    use super::memory::{Memory, OutOfRange, write_across};
    #[pymodule_export]
    use super::poller::{PolledDevice, Poller, plan_blocks};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
