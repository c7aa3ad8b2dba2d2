//! `BatchRefused`: which write of a batch was refused, and why.

use holdfast_memory::{Refusal, Refused};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

pyo3::create_exception!(
    holdfast._core,
    BatchRefused,
    PyValueError,
    "A write of a batch was refused."
);

pub(crate) fn refused(py: Python<'_>, Refused { index, refusal: because }: Refused) -> PyErr {
    let error = refusal(py, index, None, reason(because));
    let noted = error.value(py).setattr("detail", because.to_string());
    noted.err().unwrap_or(error)
}

pub(crate) fn refusal(
    py: Python<'_>,
    command: usize,
    index: Option<usize>,
    reason: &'static str,
) -> PyErr {
    let place = index.map_or_else(String::new, |index| format!("values[{index}]: "));
    let error = BatchRefused::new_err(format!("writes[{command}]: {place}{reason}"));
    let value = error.value(py);
    let noted = value
        .setattr("command", command)
        .and_then(|()| value.setattr("index", index))
        .and_then(|()| value.setattr("reason", reason));
    noted.err().unwrap_or(error)
}

pub(crate) const fn reason(refusal: Refusal) -> &'static str {
    match refusal {
        Refusal::Sealed => "sealed",
        Refusal::Unsealed => "unsealed",
        Refusal::OutOfRange => "out_of_range",
        Refusal::GateBit => "gate_bit",
        Refusal::WrongLength => "wrong_length",
        Refusal::Mirrored => "mirrored",
        Refusal::Stale => "stale",
        Refusal::Overtaken => "overtaken",
        Refusal::NotRegisters => "not_registers",
        // What is wrong with the log is in its status.
        Refusal::Unavailable | Refusal::Behind | Refusal::Differs => "log_unavailable",
        Refusal::Busy => "busy",
        Refusal::TooLarge { .. } => "too_large",
        Refusal::NotStored => "not_stored",
        Refusal::NotConfirmed => "not_confirmed",
        Refusal::NotOneStep => "not_one_step",
    }
}
