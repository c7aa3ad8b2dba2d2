//! Constants of the module: areas, functions and their limits, names of exceptions, device faults,
//! reasons of TLS failures.
//! Python takes them from here and keeps no list of its own.

use holdfast_engine::link::Fault;
use holdfast_engine::server::functions::{OTHER_READS, WRITE_FILE_RECORD};
use holdfast_engine::tls::TlsFailure;
use holdfast_memory::{Area, Span};
use holdfast_protocol::pdu::{self, ExceptionCode, Function, SubFunction, limit};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

pub fn add(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("ADDRESSES", Span::MAX_SIZE)?;
    module.add("MAX_PDU", pdu::MAX_LEN)?;
    module.add("AREAS", PyTuple::new(py, Area::ALL.map(Area::name))?)?;
    let functions = (0..=u8::MAX).filter_map(Function::from_code).map(|function| {
        let of = use_of(function);
        let area = of.area.map(Area::name);
        let (code, name) = (function.code(), function.name());
        (code, name, function.is_write(), area, of.most_read, of.most_written)
    });
    module.add("FUNCTIONS", PyTuple::new(py, functions.collect::<Vec<_>>())?)?;
    module.add("OTHER_READS", PyTuple::new(py, OTHER_READS)?)?;
    module.add("WRITE_FILE_RECORD", WRITE_FILE_RECORD)?;
    let sub_functions = (0..=u16::MAX).filter_map(SubFunction::from_code);
    let sub_functions = sub_functions.map(|each| (each.code(), each.name(), each.changes_state()));
    module.add("SUB_FUNCTIONS", PyTuple::new(py, sub_functions.collect::<Vec<_>>())?)?;
    let exceptions = PyDict::new(py);
    for code in (0..=u8::MAX).filter_map(ExceptionCode::from_code) {
        exceptions.set_item(code.code(), code.name())?;
    }
    module.add("EXCEPTIONS", exceptions)?;
    let faults = PyDict::new(py);
    let all = [
        Fault::Timeout,
        Fault::Refused,
        Fault::Reset,
        Fault::Invalid,
        Fault::Unplanned,
        Fault::Unstored,
        Fault::Internal,
        Fault::Flooded,
        Fault::Standby,
        Fault::Expired,
        Fault::Unreachable,
    ];
    for fault in all {
        if let Some(word) = word(fault) {
            faults.set_item(word, fault.code())?;
        }
    }
    module.add("FAULTS", faults)?;
    module.add("TLS_REASONS", PyTuple::new(py, TlsFailure::REASONS)?)
}

/// The name of a fault; `None` for an exception, which has a name in `EXCEPTIONS`.
fn word(fault: Fault) -> Option<&'static str> {
    match fault {
        Fault::Exception(_) => None,
        Fault::Timeout => Some("timeout"),
        Fault::Refused => Some("refused"),
        Fault::Reset => Some("reset"),
        Fault::Invalid => Some("invalid reply"),
        Fault::Unplanned => Some("no plan"),
        Fault::Unstored => Some("not stored"),
        Fault::Internal => Some("internal error"),
        Fault::Flooded => Some("flooded"),
        Fault::Standby => Some("standby"),
        Fault::Expired => Some("expired"),
        Fault::Unreachable => Some("unreachable"),
    }
}

/// The area that a function reads or writes, if any, and the most items per request.
struct Use {
    area: Option<Area>,
    most_read: u16,
    most_written: u16,
}

fn use_of(function: Function) -> Use {
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
        Function::Diagnostics
        | Function::GetCommEventCounter
        | Function::ReportServerId
        | Function::EncapsulatedInterface => {
            return Use { area: None, most_read: 0, most_written: 0 };
        }
    };
    Use { area: Some(area), most_read, most_written }
}
