//! `Log` and `LogReader`: memories that several nodes share.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use holdfast_journal::log::{
    ClientIdentity, Log as Core, LogError as CoreError, LogReader as CoreReader, Login, Phase,
    Record, Settings, Tls, Until, check_name, check_node,
};
use holdfast_memory::{Access, Action, Memory as CoreMemory, Step, StepWrite};
use holdfast_runtime::lock;
use pyo3::exceptions::{PyException, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict, PyList};

use crate::arguments::{seconds, within, word};
use crate::batch_refusal::reason;
use crate::memory::Memory;
use crate::python_values::listed;

pyo3::create_exception!(
    holdfast._core,
    LogError,
    PyException,
    "A log can't be used. `kind` tells why, as one word."
);

#[pyfunction]
pub fn check_log_name(name: &str) -> PyResult<()> {
    check_name(name).map_err(PyValueError::new_err)
}

#[pyfunction]
pub fn check_log_node(name: &str) -> PyResult<()> {
    check_node(name).map_err(PyValueError::new_err)
}

/// How much longer a start may take while it waits for other nodes to say whether seals stay open: they answer
/// within 10 s, and messages of other nodes may delay that which closes the seals.
const ASKING: Duration = Duration::from_secs(30);

/// The longest time between two checks for signals.
const SLICE: Duration = Duration::from_millis(100);

/// Names and memories.
type Memories<'py> = Vec<(String, PyRef<'py, Memory>)>;

/// The files of TLS: trusted authorities, certificate, key.
type TlsFiles = (Option<PathBuf>, Option<PathBuf>, Option<PathBuf>);

#[pyclass(frozen, module = "holdfast")]
pub struct Log {
    pub core: Arc<Core>,
}

#[pymethods]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
impl Log {
    #[new]
    #[pyo3(signature = (name, node, servers, memories, *, replicas=None, write_timeout=None, when_behind=None, max_lag=None, digest_steps=None, cut_off=None, kept_file=None, user=None, password_file=None, token_file=None, credentials_file=None, tls=None))]
    fn new(
        name: &str,
        node: &str,
        servers: Vec<String>,
        memories: Memories<'_>,
        replicas: Option<i128>,
        write_timeout: Option<f64>,
        when_behind: Option<&str>,
        max_lag: Option<f64>,
        digest_steps: Option<i128>,
        cut_off: Option<f64>,
        kept_file: Option<String>,
        user: Option<String>,
        password_file: Option<PathBuf>,
        token_file: Option<PathBuf>,
        credentials_file: Option<PathBuf>,
        tls: Option<TlsFiles>,
    ) -> PyResult<Log> {
        let mut settings = Settings::new(name, node, servers);
        if let Some(replicas) = replicas {
            settings.replicas = within("replicas", replicas, 1..=5)?;
        }
        if let Some(write_timeout) = write_timeout {
            settings.write_timeout = seconds("write_timeout", write_timeout)?;
        }
        if let Some(when_behind) = when_behind {
            settings.refuses_when_behind =
                word("when_behind", when_behind, &[("serve", false), ("refuse", true)])?;
        }
        if let Some(max_lag) = max_lag {
            settings.max_lag = seconds("max_lag", max_lag)?;
        }
        if let Some(digest_steps) = digest_steps {
            let most = u32::MAX as usize;
            settings.digest_steps = within("digest_steps", digest_steps, 1..=most)? as u64;
        }
        if let Some(cut_off) = cut_off {
            settings.max_cut_off = seconds("cut_off", cut_off)?;
        }
        settings.memory_file = kept_file;
        settings.servers.login = login(user, password_file, token_file, credentials_file)?;
        settings.servers.tls = tls.map(tls_of).transpose()?;
        let core = Core::new(settings, named(&memories)).map_err(to_py_err)?;
        Ok(Log { core: Arc::new(core) })
    }

    fn resume(&self, note: &[u8]) -> PyResult<()> {
        self.core.resume(note).map_err(to_py_err)
    }

    fn start(&self, py: Python<'_>, timeout: f64) -> PyResult<()> {
        let timeout = seconds("timeout", timeout)?;
        let began = Instant::now();
        self.core.start().map_err(to_py_err)?;
        loop {
            let most = if self.core.awaits_seal_answer() { timeout + ASKING } else { timeout };
            let left = most.saturating_sub(began.elapsed()).min(SLICE);
            let caught_up =
                py.detach(|| self.core.wait_until_caught_up(left)).map_err(to_py_err)?;
            if caught_up {
                return Ok(());
            }
            let signalled = py.check_signals();
            if signalled.is_err() || began.elapsed() >= most {
                let error = self.core.startup_timeout_error(most);
                py.detach(|| self.core.stop());
                return signalled.and(Err(to_py_err(error)));
            }
        }
    }

    fn stop(&self, py: Python<'_>) {
        py.detach(|| self.core.stop());
    }

    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let status = py.detach(|| self.core.status());
        let shown = PyDict::new(py);
        let (phase, error) = match &status.phase {
            Phase::Starting => ("starting", None),
            Phase::Running => ("running", None),
            Phase::Stopped => ("stopped", None),
            Phase::Returning(error) => ("returning", Some((error.kind(), error.to_string()))),
            Phase::Failed(error) => ("failed", Some((error.kind(), error.to_string()))),
        };
        shown.set_item("phase", phase)?;
        shown.set_item("failure", error)?;
        shown.set_item("connected", status.server.is_some())?;
        shown.set_item("server", status.server)?;
        shown.set_item("last_error", status.last_error)?;
        shown.set_item("contact_age", status.contact_age.map(|age| age.as_secs_f64()))?;
        shown.set_item("sequence", status.sequence)?;
        shown.set_item("last_sequence", status.last_sequence)?;
        shown.set_item("lag", status.last_sequence - status.sequence)?;
        shown.set_item("steps", status.steps)?;
        shown.set_item("unavailable", status.unavailable)?;
        shown.set_item("not_confirmed", status.not_confirmed)?;
        shown.set_item("not_stored", status.too_large)?;
        shown.set_item("refused", status.refused)?;
        shown.set_item("stale", status.stale)?;
        shown.set_item("ignored", status.ignored)?;
        shown.set_item("replicas", status.replicas)?;
        let digest = status.digest.map(|own| (own.sequence, own.digest, own.agrees));
        shown.set_item("digest", digest)?;
        shown.set_item("snapshot", status.snapshot)?;
        let nodes = PyList::empty(py);
        for (name, node) in status.nodes {
            let one = PyDict::new(py);
            one.set_item("name", name)?;
            one.set_item("sequence", node.sequence)?;
            one.set_item("time_ns", node.stored)?;
            one.set_item("digest", node.digest)?;
            nodes.append(one)?;
        }
        shown.set_item("nodes", nodes)?;
        Ok(shown)
    }

    fn events<'py>(
        &self,
        py: Python<'py>,
        timeout: f64,
    ) -> PyResult<Vec<(&'static str, Bound<'py, PyDict>)>> {
        let timeout = seconds("timeout", timeout)?;
        let events = py.detach(|| self.core.take_events(timeout));
        let events = events.into_iter();
        events.map(|event| Ok((event.name, event.fields.into_py_dict(py)?))).collect()
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct LogReader {
    core: Mutex<CoreReader>,
    names: Vec<String>,
}

#[pymethods]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
impl LogReader {
    #[new]
    #[pyo3(signature = (name, servers, memories, *, sequence=None, time_ns=None, follow=false, timeout=10.0, connect_timeout=None, user=None, password_file=None, token_file=None, credentials_file=None, tls=None))]
    fn new(
        py: Python<'_>,
        name: &str,
        servers: Vec<String>,
        memories: Memories<'_>,
        sequence: Option<u64>,
        time_ns: Option<i64>,
        follow: bool,
        timeout: f64,
        connect_timeout: Option<f64>,
        user: Option<String>,
        password_file: Option<PathBuf>,
        token_file: Option<PathBuf>,
        credentials_file: Option<PathBuf>,
        tls: Option<TlsFiles>,
    ) -> PyResult<LogReader> {
        let until = match (sequence, time_ns, follow) {
            (Some(sequence), None, false) => Until::Sequence(sequence),
            (None, Some(time), false) => Until::Time(time),
            (None, None, true) => Until::Forever,
            (None, None, false) => Until::Now,
            _ => {
                let message = "give at most one of sequence, time_ns and follow";
                return Err(PyValueError::new_err(message));
            }
        };
        let mut settings = Settings::new(name, "replay", servers);
        if let Some(connect_timeout) = connect_timeout {
            settings.servers.connect_timeout = seconds("connect_timeout", connect_timeout)?;
        }
        settings.servers.login = login(user, password_file, token_file, credentials_file)?;
        settings.servers.tls = tls.map(tls_of).transpose()?;
        let timeout = seconds("timeout", timeout)?;
        let members = named(&memories);
        let mut names: Vec<String> = members.iter().map(|(name, _)| name.clone()).collect();
        names.sort();
        let core = py.detach(|| CoreReader::open(&settings, members, until, timeout));
        Ok(LogReader { core: Mutex::new(core.map_err(to_py_err)?), names })
    }

    fn next<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Bound<'py, PyDict>>> {
        let timeout = seconds("timeout", timeout)?;
        let record = py.detach(|| self.locked(|core| core.next(timeout))).map_err(to_py_err)?;
        record.map(|record| self.record_to_python(py, &record)).transpose()
    }

    #[getter]
    fn ended(&self, py: Python<'_>) -> bool {
        py.detach(|| self.locked(|core| core.has_ended()))
    }

    #[getter]
    fn sequence(&self, py: Python<'_>) -> u64 {
        py.detach(|| self.locked(|core| core.sequence()))
    }

    #[getter]
    fn time_ns(&self, py: Python<'_>) -> i64 {
        py.detach(|| self.locked(|core| core.stored()))
    }

    #[getter]
    fn last_sequence(&self, py: Python<'_>) -> u64 {
        py.detach(|| self.locked(|core| core.last_sequence()))
    }

    fn digest(&self, py: Python<'_>) -> String {
        py.detach(|| self.locked(|core| core.digest()))
    }
}

impl LogReader {
    fn locked<T>(&self, work: impl FnOnce(&mut CoreReader) -> T) -> T {
        work(&mut lock(&self.core))
    }

    fn record_to_python<'py>(
        &self,
        py: Python<'py>,
        record: &Record,
    ) -> PyResult<Bound<'py, PyDict>> {
        let shown = PyDict::new(py);
        shown.set_item("sequence", record.sequence)?;
        shown.set_item("time_ns", record.stored)?;
        shown.set_item("node", record.origin.as_ref().map(|origin| &origin.node))?;
        shown.set_item("fresh", record.fresh)?;
        let steps = PyList::empty(py);
        for (index, step) in record.steps.iter().enumerate() {
            let shown = self.step(py, step)?;
            if let Some(refusal) = record.refusals.get(index).copied().flatten() {
                shown.set_item("refused", reason(refusal))?;
            }
            steps.append(shown)?;
        }
        shown.set_item("steps", steps)?;
        Ok(shown)
    }

    fn step<'py>(&self, py: Python<'py>, step: &Step) -> PyResult<Bound<'py, PyDict>> {
        let shown = PyDict::new(py);
        let access = match step.access {
            Access::Client => "client",
            Access::Ingest => "ingest",
            Access::Mirror => "mirror",
            Access::Restore => "restore",
        };
        shown.set_item("access", access)?;
        let name = |member: u16| &self.names[usize::from(member)];
        let written = |write: &StepWrite| {
            let values = listed(py, write.area, write.count, &write.bytes)?;
            Ok::<_, PyErr>((name(write.member), write.area.name(), write.address, values))
        };
        match &step.action {
            Action::Write(writes) => {
                shown.set_item("action", "write")?;
                let writes = writes.iter().map(written).collect::<PyResult<Vec<_>>>()?;
                shown.set_item("writes", writes)?;
            }
            Action::Mask { member, area, address, and_mask, or_mask } => {
                shown.set_item("action", "mask")?;
                shown.set_item("place", (name(*member), area.name(), address))?;
                shown.set_item("masks", (and_mask, or_mask))?;
            }
            Action::WriteThenRead { write, area, address, count } => {
                shown.set_item("action", "write_then_read")?;
                shown.set_item("writes", vec![written(write)?])?;
                shown.set_item("read", (name(write.member), area.name(), address, count))?;
            }
        }
        Ok(shown)
    }
}

fn named(memories: &Memories<'_>) -> Vec<(String, Arc<CoreMemory>)> {
    memories.iter().map(|(name, memory)| (name.clone(), Arc::clone(&memory.core))).collect()
}

fn login(
    user: Option<String>,
    password_file: Option<PathBuf>,
    token_file: Option<PathBuf>,
    credentials_file: Option<PathBuf>,
) -> PyResult<Login> {
    match (user, password_file, token_file, credentials_file) {
        (None, None, None, None) => Ok(Login::None),
        (Some(name), password_file, None, None) => Ok(Login::User { name, password_file }),
        (None, None, Some(file), None) => Ok(Login::Token { file }),
        (None, None, None, Some(file)) => Ok(Login::Credentials { file }),
        _ => Err(PyValueError::new_err(
            "give user (with or without password_file), token_file or credentials_file, not several",
        )),
    }
}

fn tls_of((ca, cert, key): TlsFiles) -> PyResult<Tls> {
    let identity = match (cert, key) {
        (Some(cert), Some(key)) => Some(ClientIdentity { cert, key }),
        (None, None) => None,
        _ => return Err(PyValueError::new_err("tls: give certificate and key, or neither")),
    };
    Ok(Tls { ca, identity })
}

fn to_py_err(error: CoreError) -> PyErr {
    if let CoreError::Settings(text) = error {
        return PyValueError::new_err(text);
    }
    let raised = LogError::new_err(error.to_string());
    let noted = Python::attach(|py| raised.value(py).setattr("kind", error.kind()));
    noted.err().unwrap_or(raised)
}
