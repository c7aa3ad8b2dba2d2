//! What the settings of a device must be.

use holdfast_protocol::pdu::limit;

use super::error::PollerError;
use crate::poller::device::{DeviceSettings, Planned};
use crate::poller::forwarding::ForwardSettings;
use crate::poller::plan::PlanLimits;
use crate::poller::{Destination, StatusSettings};

/// Checks the settings of a device and plans its reads.
pub(super) fn checked(device: DeviceSettings) -> Result<Planned, PollerError> {
    let name = || device.name.clone();
    let PlanLimits { max_registers, max_bits, .. } = device.limits;
    for (items, found, most) in
        [("registers", max_registers, limit::READ_REGISTERS), ("bits", max_bits, limit::READ_BITS)]
    {
        if !(1..=most).contains(&found) {
            return Err(PollerError::Limit { device: name(), items, found, most });
        }
    }
    for (read, settings) in device.reads.iter().enumerate() {
        if settings.count == 0 || settings.count > 65_536 - u32::from(settings.address) {
            return Err(PollerError::Beyond { device: name(), read });
        }
        let alike = |into: &Destination| {
            into.area.is_bits() == settings.area.is_bits() && into.holds(settings.count)
        };
        if !settings.into.as_ref().is_none_or(alike) {
            return Err(PollerError::Destination { device: name(), read });
        }
        if !settings.forward || device.forward.is_empty() {
            continue;
        }
        if settings.count > u32::from(u16::MAX) {
            return Err(PollerError::Forward { device: name(), read });
        }
        let (area, address) = match &settings.into {
            Some(into) => (into.area, into.address),
            None => (settings.area, settings.address),
        };
        let last = u32::from(address) + settings.count - 1;
        let fits = |forward: &ForwardSettings| {
            u16::try_from(last).is_ok_and(|last| forward.address(area, last).is_some())
        };
        if let Some(forward) = device.forward.iter().position(|forward| !fits(forward)) {
            return Err(PollerError::Offset { device: name(), forward, read });
        }
    }
    let is_wrong = |forward: &ForwardSettings| {
        forward.status.as_ref().is_some_and(|(_, block)| !block.is_possible())
    };
    if let Some(forward) = device.forward.iter().position(is_wrong) {
        return Err(PollerError::ForwardedStatus { device: name(), forward });
    }
    if !device.status.as_ref().is_none_or(StatusSettings::fits) {
        return Err(PollerError::Status { device: name() });
    }
    let name = name();
    Planned::new(device).map_err(|error| PollerError::Plan { device: name, error })
}
