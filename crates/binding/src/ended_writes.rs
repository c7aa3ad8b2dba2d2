//! Calls Python with the outcomes of writes that journals carry out.
//!
//! A journal never waits for Python, because the writes of Modbus clients would wait with it: a thread of its
//! own makes the calls.

use std::iter::once;
use std::sync::LazyLock;
use std::sync::mpsc::{SendError, Sender, channel};

use holdfast_memory::{Outcome, Refusal, Refused};
use pyo3::prelude::*;

use crate::batch_refusal::refused;

/// A function of Python that waits for the outcome of a write, and the number of its values.
pub struct Waiting(Option<(Py<PyAny>, usize)>);

impl Waiting {
    pub fn new(function: Py<PyAny>, count: usize) -> Waiting {
        Waiting(Some((function, count)))
    }

    pub fn end(&mut self, outcome: Outcome) {
        if let Some((function, count)) = self.0.take() {
            let ended = Ended { function, count, outcome };
            if let Err(SendError(ended)) = ENDED.send(ended) {
                Python::try_attach(|py| ended.call(py));
            }
        }
    }
}

impl Drop for Waiting {
    /// The journal has ended without an outcome.
    fn drop(&mut self) {
        self.end(Err(Refused { index: 0, refusal: Refusal::NotConfirmed }));
    }
}

struct Ended {
    function: Py<PyAny>,
    count: usize,
    outcome: Outcome,
}

impl Ended {
    fn call(self, py: Python<'_>) {
        let called = match self.outcome {
            Ok(done) => self.function.call1(py, ((self.count, done.sequence),)),
            Err(error) => self.function.call1(py, (refused(py, error),)),
        };
        if let Err(error) = called {
            error.write_unraisable(py, Some(self.function.bind(py)));
        }
    }
}

/// What has ended, for the thread that calls Python.
static ENDED: LazyLock<Sender<Ended>> = LazyLock::new(|| {
    let (sender, receiver) = channel::<Ended>();
    let work = move || {
        while let Ok(first) = receiver.recv() {
            let all = once(first).chain(receiver.try_iter());
            Python::try_attach(|py| all.for_each(|ended| ended.call(py)));
        }
    };
    // Without the thread, the receiver is dropped, and whoever sends calls Python.
    let _ = std::thread::Builder::new().name("holdfast-kept".into()).spawn(work);
    sender
});
