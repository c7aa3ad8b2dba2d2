//! Constants that Python takes from the core: areas, functions and their limits, names of exceptions
//! and faults, and defaults.

use holdfast_engine::link::{Fault, InFlight, LinkSettings};
use holdfast_engine::poller::{RETRY_REFUSED_AFTER, UNMEASURED_COST_MS};
use holdfast_engine::tls::TlsFailure;
use holdfast_journal::log::{CONTACTS_PER_LAG, MAX_LAG, WRITE_TIMEOUT};
use holdfast_memory::{Area, Span};
use holdfast_protocol::client::MAX_LATENESS;
use holdfast_protocol::pdu::{self, ExceptionCode, Function, SubFunction, limit};
use holdfast_runtime::Retry;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyTuple};

pub fn add(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("ADDRESSES", Span::MAX_SIZE)?;
    module.add("MAX_PDU", pdu::MAX_LEN)?;
    module.add("READ_RECORDS", limit::READ_RECORDS)?;
    module.add("WRITE_RECORDS", limit::WRITE_RECORDS)?;
    module.add("LAST_RECORD", limit::LAST_RECORD)?;
    module.add("AREAS", PyTuple::new(py, Area::ALL.map(Area::name))?)?;
    let functions = (0..=u8::MAX).filter_map(Function::from_code).map(|function| {
        let (area, most_read, most_written) = area_and_limits(function);
        let area = area.map(Area::name);
        let (code, name) = (function.code(), function.name());
        (code, name, function.is_write(), area, most_read, most_written)
    });
    module.add("FUNCTIONS", PyTuple::new(py, functions.collect::<Vec<_>>())?)?;
    let readers = READ_FUNCTIONS.map(|(area, function)| (area.name(), function.code()));
    module.add("READ_FUNCTIONS", PyTuple::new(py, readers)?)?;
    let sub_functions = (0..=u16::MAX).filter_map(SubFunction::from_code);
    let sub_functions = sub_functions.map(|each| (each.code(), each.name(), each.changes_state()));
    module.add("SUB_FUNCTIONS", PyTuple::new(py, sub_functions.collect::<Vec<_>>())?)?;
    let exceptions = ExceptionCode::ALL.iter().map(|code| (code.code(), code.name()));
    module.add("EXCEPTIONS", exceptions.into_py_dict(py)?)?;
    let faults = Fault::NAMED.iter().map(|(fault, word)| (word, fault.code()));
    module.add("FAULTS", faults.into_py_dict(py)?)?;
    module.add("TLS_REASONS", PyTuple::new(py, TlsFailure::REASONS)?)?;
    module.add("MAX_LATENESS_S", MAX_LATENESS.as_secs_f64())?;
    let Retry { first, most, .. } = Retry::default();
    module.add("RETRY_PAUSES_S", (first.as_secs_f64(), most.as_secs_f64()))?;
    module.add("UNMEASURED_COST_MS", UNMEASURED_COST_MS)?;
    module.add("RETRY_REFUSED_AFTER_S", RETRY_REFUSED_AFTER.as_secs_f64())?;
    module.add("MAX_IN_FLIGHT", InFlight::MAX)?;
    module.add("LINK_QUEUE", LinkSettings::QUEUE)?;
    module.add("MAX_LINK_QUEUE", LinkSettings::MAX_QUEUE)?;
    module.add("WRITE_TIMEOUT_S", WRITE_TIMEOUT.as_secs_f64())?;
    module.add("CONTACTS_PER_LAG", CONTACTS_PER_LAG)?;
    module.add("MAX_LAG_S", MAX_LAG.as_secs_f64())
}

/// The function that reads an area, and does nothing else.
const READ_FUNCTIONS: [(Area, Function); Area::ALL.len()] = [
    (Area::Coils, Function::ReadCoils),
    (Area::DiscreteInputs, Function::ReadDiscreteInputs),
    (Area::HoldingRegisters, Function::ReadHoldingRegisters),
    (Area::InputRegisters, Function::ReadInputRegisters),
];

/// The area whose items are in a request or its reply, if any, and the most items of one request: read, written.
fn area_and_limits(function: Function) -> (Option<Area>, u16, u16) {
    let (area, most_read, most_written) = match function {
        Function::ReadCoils => (Area::Coils, limit::READ_BITS, 0),
        Function::ReadDiscreteInputs => (Area::DiscreteInputs, limit::READ_BITS, 0),
        Function::ReadHoldingRegisters => (Area::HoldingRegisters, limit::READ_REGISTERS, 0),
        Function::ReadInputRegisters => (Area::InputRegisters, limit::READ_REGISTERS, 0),
        Function::WriteSingleCoil => (Area::Coils, 0, 1),
        Function::WriteSingleRegister | Function::MaskWriteRegister => {
            (Area::HoldingRegisters, 0, 1)
        }
        Function::WriteMultipleCoils => (Area::Coils, 0, limit::WRITE_BITS),
        Function::WriteMultipleRegisters => (Area::HoldingRegisters, 0, limit::WRITE_REGISTERS),
        Function::ReadWriteMultipleRegisters => {
            (Area::HoldingRegisters, limit::READ_REGISTERS, limit::READ_WRITE_REGISTERS)
        }
        Function::ReadExceptionStatus
        | Function::Diagnostics
        | Function::GetCommEventCounter
        | Function::GetCommEventLog
        | Function::ReportServerId
        | Function::ReadFileRecord
        | Function::WriteFileRecord
        | Function::ReadFifoQueue
        | Function::EncapsulatedInterface => {
            return (None, 0, 0);
        }
    };
    (Some(area), most_read, most_written)
}
