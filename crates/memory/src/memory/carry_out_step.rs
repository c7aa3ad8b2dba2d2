//! Carries out steps.

use std::sync::Arc;
use std::time::Duration;

use crate::error::Refused;
use crate::memory::checks::Ranges;
use crate::memory::several_memories::carry_out_across;
use crate::memory::{Memory, Writer};
use crate::operation::{Read, Write};
use crate::step::{Action, CarriedOut, Outcome, Step};

impl Step {
    /// Carries out the step, atomically, and returns what it reads. Reservations of ranges for
    /// [`Access::Mirror`](crate::Access::Mirror) are ignored: they were settled where the step comes from.
    ///
    /// # Errors
    /// As [`Memory::write_many`], [`Memory::mask_write`] and [`Memory::write_then_read`]. Nothing has
    /// changed then.
    ///
    /// # Panics
    /// The step names a member that does not exist.
    pub fn carry_out(&self, members: &[Arc<Memory>]) -> Outcome {
        self.carry_out_late(members, Some(Duration::ZERO))
    }

    /// The same for a step whose values are that old: ranges that mirror a device are no newer then. If
    /// their age is unknown, such ranges stay as old as they were.
    ///
    /// # Errors
    /// As [`Step::carry_out`].
    ///
    /// # Panics
    /// As [`Step::carry_out`].
    pub fn carry_out_late(&self, members: &[Arc<Memory>], age: Option<Duration>) -> Outcome {
        let alone = |refusal| Refused { index: 0, refusal };
        let lease = self.tenure.map(|tenure| tenure.lease);
        let writer = Writer { access: self.access, age, lease };
        let read = match &self.action {
            Action::Write(writes) => {
                let writes: Vec<(&Memory, Write)> = writes
                    .iter()
                    .map(|write| (&*members[usize::from(write.member)], write.borrowed()))
                    .collect();
                carry_out_across(writer, &writes).map(|()| Vec::new())?
            }
            &Action::Mask { member, area, address, and_mask, or_mask } => members
                [usize::from(member)]
            .mask(self.access, (area, address), (and_mask, or_mask), Ranges::All)
            .map(|()| Vec::new())
            .map_err(alone)?,
            &Action::WriteThenRead { ref write, area, address, count } => {
                let mut out = vec![0; area.byte_len(count)];
                let read = Read { area, address, count, out: &mut out };
                members[usize::from(write.member)]
                    .change_then_read(writer, write.borrowed(), read, Ranges::All)
                    .map_err(alone)?;
                out
            }
        };
        Ok(CarriedOut { read, sequence: None })
    }
}
