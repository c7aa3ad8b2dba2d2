//! Converts writes into the dictionaries of the audit log, and those of JSON commands into its lines. The number, the
//! time and the link to the line before are added by `events/audit/chain.py`.

use std::io::Write as _;

use holdfast_engine::raw_ingest_areas::of_packet;
use holdfast_engine::server::reports::audit::{Record, Written};
use holdfast_memory::{Area, Write};
use holdfast_protocol::pdu::{ExceptionCode, Request};
use holdfast_protocol::raw_ingest::{Format, Header};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::peer;
use crate::python_values::{items, listed};

/// The line of one write of a command, in JSON. `origin` is its beginning, `name` that of the memory.
pub fn line(
    origin: &[u8],
    name: &[u8],
    &Write { area, address, count, bytes }: &Write<'_>,
    outcome: &str,
    sequence: Option<u64>,
) -> Vec<u8> {
    let mut line =
        [origin, b",\"memory\":", name, b",\"area\":\"", area.name().as_bytes()].concat();
    line.extend_from_slice(format!("\",\"address\":{address},\"values\":").as_bytes());
    for (index, value) in items(area, count, bytes).enumerate() {
        line.push(if index == 0 { b'[' } else { b',' });
        // A vector takes whatever is written.
        let _ = write!(line, "{value}");
    }
    let _ = write!(line, "],\"outcome\":\"{outcome}\"");
    if let Some(sequence) = sequence {
        let _ = write!(line, ",\"log_sequence\":{sequence}");
    }
    line.push(b'}');
    line
}

pub fn to_python<'py>(py: Python<'py>, record: &Record) -> PyResult<Bound<'py, PyDict>> {
    let line = PyDict::new(py);
    line.set_item("listener", &*record.listener)?;
    match &record.peer {
        Some(from) => peer::add_to(&line, from)?,
        None => line.set_item("peer", py.None())?,
    }
    match &record.write {
        Written::Modbus { unit_id, memory, pdu, refused, route } => {
            line.set_item("unit", unit_id)?;
            if let Some(route) = route {
                line.set_item("route", &**route)?;
            }
            line.set_item("function", pdu.first())?;
            if let Some(memory) = memory {
                line.set_item("memory", &**memory)?;
            }
            request(&line, pdu)?;
            line.set_item("outcome", refused.map_or_else(|| "done".into(), exception))?;
        }
        Written::Packet { format, header, payload, refused } => {
            line.set_item("function", "raw-ingest")?;
            if let Some(header) = header {
                packet(&line, *format, header, payload)?;
            }
            line.set_item("outcome", refused.map_or("done", |refusal| refusal.name()))?;
        }
    }
    if let Some(sequence) = record.log_sequence {
        line.set_item("log_sequence", sequence)?;
    }
    if record.refusals > 0 {
        line.set_item("refusals", record.refusals)?;
    }
    Ok(line)
}

/// Adds area, address and values of a Modbus request, or the PDU if memories do not know the request.
fn request(line: &Bound<'_, PyDict>, pdu: &[u8]) -> PyResult<()> {
    let (area, address, values) = match Request::parse(pdu) {
        Ok(Request::WriteSingleCoil { address, value }) => {
            (Area::Coils, address, vec![u16::from(value)])
        }
        Ok(Request::WriteSingleRegister { address, value }) => {
            (Area::HoldingRegisters, address, vec![value])
        }
        Ok(Request::WriteMultipleCoils { address, bits }) => {
            (Area::Coils, address, bits.iter().map(u16::from).collect())
        }
        Ok(Request::WriteMultipleRegisters { address, registers }) => {
            (Area::HoldingRegisters, address, registers.iter().collect())
        }
        Ok(Request::ReadWriteMultipleRegisters { write_address, registers, .. }) => {
            (Area::HoldingRegisters, write_address, registers.iter().collect())
        }
        Ok(Request::MaskWriteRegister { address, and_mask, or_mask }) => {
            line.set_item("area", Area::HoldingRegisters.name())?;
            line.set_item("address", address)?;
            line.set_item("and_mask", and_mask)?;
            return line.set_item("or_mask", or_mask);
        }
        Ok(Request::WriteFileRecord(written)) => {
            let records = PyList::empty(line.py());
            for (range, values) in written.iter() {
                let each = PyDict::new(line.py());
                each.set_item("area", Area::File(range.file()).name())?;
                each.set_item("address", range.record())?;
                each.set_item("values", values.iter().collect::<Vec<_>>())?;
                records.append(each)?;
            }
            return line.set_item("records", records);
        }
        _ => {
            let hex: String = pdu.iter().map(|byte| format!("{byte:02x}")).collect();
            return line.set_item("pdu", hex);
        }
    };
    line.set_item("area", area.name())?;
    line.set_item("address", address)?;
    line.set_item("values", values)
}

fn packet(
    line: &Bound<'_, PyDict>,
    format: Format,
    header: &Header,
    payload: &[u8],
) -> PyResult<()> {
    let (area, count) = (header.area, header.count.get());
    let target = if format == Format::V1 { "unit" } else { "memory_id" };
    line.set_item(target, header.target)?;
    line.set_item("area", area.name())?;
    line.set_item("address", header.address)?;
    if payload.is_empty() {
        return line.set_item("count", count);
    }
    let count = usize::from(count);
    line.set_item("values", listed(line.py(), of_packet(area), count, payload)?)
}

/// The name of an exception in snake case, such as `illegal_data_address`.
fn exception(code: u8) -> String {
    let known = ExceptionCode::from_code(code);
    known.map_or_else(
        || format!("exception_{code:02x}"),
        |known| known.name().to_lowercase().replace(' ', "_"),
    )
}
