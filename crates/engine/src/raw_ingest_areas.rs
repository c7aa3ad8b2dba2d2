//! Converts between the areas of Raw Ingest packets and those of memories.

use holdfast_memory::Area;
use holdfast_protocol::raw_ingest;

pub fn of_packet(area: raw_ingest::Area) -> Area {
    match area {
        raw_ingest::Area::Coils => Area::Coils,
        raw_ingest::Area::DiscreteInputs => Area::DiscreteInputs,
        raw_ingest::Area::HoldingRegisters => Area::HoldingRegisters,
        raw_ingest::Area::InputRegisters => Area::InputRegisters,
    }
}

/// `None` for a file: packets have no code for it.
pub fn in_packet(area: Area) -> Option<raw_ingest::Area> {
    Some(match area {
        Area::Coils => raw_ingest::Area::Coils,
        Area::DiscreteInputs => raw_ingest::Area::DiscreteInputs,
        Area::HoldingRegisters => raw_ingest::Area::HoldingRegisters,
        Area::InputRegisters => raw_ingest::Area::InputRegisters,
        Area::File(_) => return None,
    })
}
