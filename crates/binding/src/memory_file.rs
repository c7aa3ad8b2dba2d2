//! `MemoryFile`: a file that keeps memories.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::UNIX_EPOCH;

use holdfast_journal::file::{
    CheckpointSource, FileError, FileOnDisk, Member, MemoryFile as Core, Options, read, release,
};
use holdfast_journal::log::{Checkpoint, Log as CoreLog};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arguments::seconds;
use crate::log::Log;
use crate::memory::Memory;

pyo3::create_exception!(
    holdfast._core,
    UnusableMemoryFile,
    PyOSError,
    "What is in a file of memories can't be used."
);

#[pyclass(frozen, module = "holdfast")]
pub struct MemoryFile {
    path: PathBuf,
    core: Core,
}

/// The log of the memories of a file.
#[derive(Debug)]
struct OfLog(Arc<CoreLog>);

impl CheckpointSource for OfLog {
    fn checkpoint(&self) -> Option<Checkpoint> {
        self.0.checkpoint()
    }
}

#[pymethods]
impl MemoryFile {
    #[new]
    #[pyo3(signature = (path, memories, sync, *, of_log=false))]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        memories: Vec<(String, PyRef<'_, Memory>)>,
        sync: f64,
        of_log: bool,
    ) -> PyResult<MemoryFile> {
        let options = Options::new(seconds("sync", sync)?);
        let members = memories
            .iter()
            .map(|(name, memory)| Member { name: name.clone(), memory: Arc::clone(&memory.core) });
        let members = members.collect();
        let disk = Arc::new(FileOnDisk::new(&path));
        let open = if of_log { Core::open_of_log } else { Core::open };
        match py.detach(|| open(disk, members, options)) {
            Ok(core) => Ok(MemoryFile { path, core }),
            Err(error) => Err(to_py_err(&path, error)),
        }
    }

    #[getter]
    fn loaded(&self) -> Vec<String> {
        self.core.loaded().to_vec()
    }

    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.core.warnings().to_vec()
    }

    #[getter]
    fn note(&self) -> Option<&[u8]> {
        self.core.note()
    }

    #[pyo3(signature = (log=None))]
    fn start(&self, py: Python<'_>, log: Option<PyRef<'_, Log>>) -> PyResult<()> {
        let log =
            log.map(|log| Arc::new(OfLog(Arc::clone(&log.core))) as Arc<dyn CheckpointSource>);
        py.detach(|| self.core.start(log)).map_err(|error| to_py_err(&self.path, error))
    }

    fn stop(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.core.stop()).map_err(|error| to_py_err(&self.path, error))
    }

    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let status = py.detach(|| self.core.status());
        let since_1970 = |at: std::time::SystemTime| {
            at.duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
        };
        let shown = PyDict::new(py);
        shown.set_item("failing", status.failing)?;
        shown.set_item("stored_at", status.stored_at.map(since_1970))?;
        shown.set_item("commits", status.commits)?;
        shown.set_item("pending", status.pending)?;
        shown.set_item("refused", status.refused)?;
        shown.set_item("busy", status.busy)?;
        shown.set_item("last_commit_seconds", status.last_commit.as_secs_f64())?;
        shown.set_item("bytes", status.bytes)?;
        shown.set_item("recreated", status.recreated)?;
        Ok(shown)
    }
}

/// Checks a file without changing it, and returns the memories in it, or what was cut from them.
#[pyfunction]
#[pyo3(signature = (path, *, set_aside=false))]
pub fn read_memory_file(
    py: Python<'_>,
    path: PathBuf,
    set_aside: bool,
) -> PyResult<Bound<'_, PyDict>> {
    let memories = py.detach(|| read(&path)).map_err(|error| to_py_err(&path, error))?;
    let shown = PyDict::new(py);
    for kept in memories {
        let name = match kept.set_aside_of() {
            Some(memory) if set_aside => memory,
            None if !set_aside => &*kept.name,
            _ => continue,
        };
        let areas = PyDict::new(py);
        for area in kept.layout.areas() {
            let span = kept.layout.span(area);
            if span.size() > 0 {
                let values = (span.start(), span.size(), PyBytes::new(py, kept.bytes_of(area)));
                areas.set_item(area.name(), values)?;
            }
        }
        shown.set_item(name, areas)?;
    }
    Ok(shown)
}

/// Deletes what was cut from a memory and set aside in the file.
#[pyfunction]
pub fn release_memory_file(py: Python<'_>, path: PathBuf, memory: &str) -> PyResult<bool> {
    let disk = Arc::new(FileOnDisk::new(&path));
    py.detach(|| release(disk, memory)).map_err(|error| to_py_err(&path, error))
}

fn to_py_err(path: &Path, error: FileError) -> PyErr {
    match error {
        FileError::Memories(message) => PyValueError::new_err(message),
        // Both may pass.
        FileError::Locked | FileError::Io(_) => {
            PyOSError::new_err(format!("{}: {error}", path.display()))
        }
        error => UnusableMemoryFile::new_err(format!("{}: {error}", path.display())),
    }
}
