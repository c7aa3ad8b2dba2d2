//! Items of an area, and those that a request reads and writes.

use holdfast_memory::Area;
use holdfast_protocol::pdu::Request;

/// Items of an area.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Items {
    pub area: Area,
    pub address: u16,
    pub count: u32,
}

impl Items {
    /// The address after the last item.
    pub(crate) fn end(self) -> u32 {
        u32::from(self.address) + self.count
    }

    pub(crate) fn is_in(self, other: Items) -> bool {
        self.area == other.area && other.address <= self.address && self.end() <= other.end()
    }

    pub(crate) fn overlaps(self, other: Items) -> bool {
        self.area == other.area
            && u32::from(self.address) < other.end()
            && u32::from(other.address) < self.end()
    }
}

/// What a request reads, and what it writes. Without a wildcard: the ranges of a rule would not restrict a
/// function that it covers.
#[deny(clippy::wildcard_enum_match_arm)]
pub(crate) fn touched(request: &Request<'_>) -> (Option<Items>, Option<Items>) {
    let items = |area, address, count: u16| Some(Items { area, address, count: count.into() });
    let (coils, registers) = (Area::Coils, Area::HoldingRegisters);
    match *request {
        Request::ReadCoils(range) => (items(coils, range.address(), range.quantity()), None),
        Request::ReadDiscreteInputs(range) => {
            (items(Area::DiscreteInputs, range.address(), range.quantity()), None)
        }
        Request::ReadHoldingRegisters(range) => {
            (items(registers, range.address(), range.quantity()), None)
        }
        Request::ReadInputRegisters(range) => {
            (items(Area::InputRegisters, range.address(), range.quantity()), None)
        }
        Request::WriteSingleCoil { address, .. } => (None, items(coils, address, 1)),
        Request::WriteSingleRegister { address, .. }
        | Request::MaskWriteRegister { address, .. } => (None, items(registers, address, 1)),
        Request::WriteMultipleCoils { address, bits } => {
            (None, items(coils, address, bits.quantity()))
        }
        Request::WriteMultipleRegisters { address, registers: new } => {
            (None, items(registers, address, new.quantity()))
        }
        Request::ReadWriteMultipleRegisters { read, write_address, registers: new } => (
            items(registers, read.address(), read.quantity()),
            items(registers, write_address, new.quantity()),
        ),
        // Bits of a device, files, queues and what a server says of itself: not items of these areas.
        Request::ReadExceptionStatus
        | Request::Diagnostics(_)
        | Request::GetCommEventCounter
        | Request::GetCommEventLog
        | Request::ReportServerId
        | Request::ReadFileRecord(_)
        | Request::WriteFileRecord(_)
        | Request::ReadFifoQueue { .. }
        | Request::ReadDeviceIdentification { .. } => (None, None),
    }
}
