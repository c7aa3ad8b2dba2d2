//! `holdfast._core`: the Python interface of the native crates.
//!
//! This crate converts and forwards. Its only logic saves calls of the interpreter for REST writes
//! (`json_commands`, `request_heads`, `HttpServer::take`). It releases the interpreter around every call that can
//! block.

mod arguments;
mod audit_fields;
mod batch;
mod batch_refusal;
mod channel;
mod client;
mod connection;
mod constants;
mod ended_writes;
mod engine;
mod exchange;
mod follower;
mod heartbeat;
mod http;
mod json_commands;
mod lease_fence;
mod link;
mod listener;
mod log;
mod memory;
mod memory_file;
mod mirror_age;
mod peer;
mod poller;
mod python_values;
mod raw_ingest;
mod request_heads;
mod server_tls;
mod write_queue;
mod yaml;

use pyo3::prelude::*;

#[pymodule(gil_used = false)]
mod _core {
    use super::{Bound, PyModule, PyModuleMethods, PyResult, constants};

    #[pymodule_export]
    use super::batch::Batch;
    #[pymodule_export]
    use super::batch_refusal::BatchRefused;
    #[pymodule_export]
    use super::channel::TlsChannel;
    #[pymodule_export]
    use super::client::{BlockingClient, Endpoint, Request};
    #[pymodule_export]
    use super::connection::{Attempt, Connection};
    #[pymodule_export]
    use super::engine::Engine;
    #[pymodule_export]
    use super::exchange::HttpExchange;
    #[pymodule_export]
    use super::follower::Follower;
    #[pymodule_export]
    use super::http::{HttpServer, ListeningSocket};
    #[pymodule_export]
    use super::json_commands::{Commands, ParsedWrites};
    #[pymodule_export]
    use super::lease_fence::Fence;
    #[pymodule_export]
    use super::link::{Caller, Link, Passage, Route, Withdrawal};
    #[pymodule_export]
    use super::listener::{Listener, RawRule, Rule};
    #[pymodule_export]
    use super::log::{Log, LogError, LogReader, check_log_name, check_log_node};
    #[pymodule_export]
    use super::memory::{Memory, OutOfRange, Stale};
    #[pymodule_export]
    use super::memory_file::{
        MemoryFile, UnusableMemoryFile, read_memory_file, release_memory_file,
    };
    #[pymodule_export]
    use super::mirror_age::MirrorAge;
    #[pymodule_export]
    use super::poller::{PollReceiver, PolledDevice, Poller, plan_blocks, write_disabled_status};
    #[pymodule_export]
    use super::raw_ingest::{encode_raw_ingest, pack_raw_ingest};
    #[pymodule_export]
    use super::server_tls::{ServerTls, https_server_tls};
    #[pymodule_export]
    use super::write_queue::WriteQueue;
    #[pymodule_export]
    use super::yaml::yaml_events;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        constants::add(module)?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
