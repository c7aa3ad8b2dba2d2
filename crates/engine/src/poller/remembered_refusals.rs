//! What a device has refused, and what that shows: unreadable ranges, cuts between ranges, and the size of
//! a request. It is remembered for a while, then tried again.

use std::time::Duration;

use holdfast_memory::Area;
use tokio::time::Instant;

use super::plan::{Block, Cut, Field, PlanLimits};
use crate::link::Fault;

/// The limits are forgotten after this time, and the device is searched again.
const FORGET_AFTER: Duration = Duration::from_secs(600);

/// The interval between attempts to read an unreadable range: a change of the device can make it readable.
pub const RETRY_REFUSED_AFTER: Duration = Duration::from_secs(60);

#[derive(Debug, Default)]
pub(super) struct Learned {
    max_registers: Option<u16>,
    max_bits: Option<u16>,
    cuts: Vec<Cut>,
    unreadable: Vec<Unreadable>,
    /// When everything is forgotten.
    until: Option<Instant>,
}

/// A range that the device refuses to read.
#[derive(Debug, Clone)]
pub(super) struct Unreadable {
    /// Fields inside it may be readable.
    pub(super) range: Field,
    pub(super) fault: Fault,
    retry_at: Instant,
}

impl Learned {
    /// Forgets everything when its time is over. Returns whether it has.
    pub(super) fn forget(&mut self, now: Instant) -> bool {
        let over = self.until.is_some_and(|until| until <= now);
        if over {
            *self = Learned::default();
        }
        over
    }

    /// The device accepts at most this many items per request.
    pub(super) fn lower(&mut self, area: Area, most: u16) {
        debug_assert!(most > 0, "a limit is at least one item");
        let known = if area.is_bits() { &mut self.max_bits } else { &mut self.max_registers };
        *known = Some(known.map_or(most, |known| known.min(most)));
        self.remember();
    }

    /// Fields that end before this address are not read together with fields that begin at it.
    pub(super) fn cut(&mut self, area: Area, address: u32) {
        let cut = Cut { area, address };
        if !self.cuts.contains(&cut) {
            self.cuts.push(cut);
        }
        self.remember();
    }

    /// The device refuses this block. Replaces what is known about an equal one.
    pub(super) fn refused(&mut self, block: &Block, fault: Fault) {
        let (range, retry_at) = (block.range(), Instant::now() + RETRY_REFUSED_AFTER);
        debug_assert!(range.count > 0);
        self.unreadable.retain(|known| known.range != range);
        self.unreadable.push(Unreadable { range, fault, retry_at });
        self.remember();
    }

    /// Forgets unreadable ranges without a field. Each leaves a cut at its start.
    pub(super) fn keep(&mut self, fields: &[Field]) {
        let is_unwanted = |known: &mut Unreadable| !fields.contains(&known.range);
        let unwanted: Vec<_> = self.unreadable.extract_if(.., is_unwanted).collect();
        for Unreadable { range, .. } in unwanted {
            self.cut(range.area, range.address.into());
        }
    }

    pub(super) fn unreadable(&self) -> &[Unreadable] {
        &self.unreadable
    }

    /// The range that has waited longest for its next attempt, if that is due or `in_any_case` is
    /// set.
    pub(super) fn retry(&mut self, now: Instant, in_any_case: bool) -> Option<Field> {
        let known = self.unreadable.iter_mut().min_by_key(|known| known.retry_at)?;
        if known.retry_at > now && !in_any_case {
            return None;
        }
        known.retry_at = now + RETRY_REFUSED_AFTER;
        Some(known.range)
    }

    /// Whether a field is known to be unreadable.
    pub(super) fn is_refused(&self, field: &Field) -> bool {
        self.unreadable.iter().any(|known| known.range == *field)
    }

    /// The limits for requests that read these fields. They never make a field unreadable.
    pub(super) fn limits(&self, of: &PlanLimits, fields: &[Field]) -> PlanLimits {
        let longest = |bits: bool| {
            let alike = fields.iter().filter(|field| field.area.is_bits() == bits);
            alike.map(|field| field.count).fold(1, u16::max)
        };
        let within = |known: Option<u16>, most: u16, bits: bool| {
            known.map_or(most, |known| most.min(known.max(longest(bits))))
        };
        let mut limits = of.clone();
        limits.max_registers = within(self.max_registers, of.max_registers, false);
        limits.max_bits = within(self.max_bits, of.max_bits, true);
        limits.cuts.extend(&self.cuts);
        for Unreadable { range, .. } in &self.unreadable {
            let ends = [range.address.into(), range.end()];
            limits.cuts.extend(ends.map(|address| Cut { area: range.area, address }));
        }
        limits
    }

    fn remember(&mut self) {
        self.until.get_or_insert_with(|| Instant::now() + FORGET_AFTER);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_that_is_refused_again_is_known_once() {
        let mut learned = Learned::default();
        let block = |address| {
            let area = Area::HoldingRegisters;
            Block { area, address, count: 1, fields: vec![0], gaps: 0 }
        };
        for (address, code) in [(7, 2), (8, 2), (7, 3)] {
            learned.refused(&block(address), Fault::Exception(code));
        }
        let known = learned.unreadable().iter().map(|known| (known.range.address, known.fault));
        let expected = [(8, Fault::Exception(2)), (7, Fault::Exception(3))];
        assert_eq!(known.collect::<Vec<_>>(), expected);
    }
}
