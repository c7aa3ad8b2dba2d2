//! What becomes of a block that a device refuses: it is halved until what can't be read is alone, and
//! then put together again as far as the device bears. That takes a few requests, once.

use super::device::{Device, Gathered};
use super::plan::{self, Block};
use super::status::Fault;

/// The exceptions that speak of what was asked for, not of the device.
const ILLEGAL: [u8; 2] = [2, ILLEGAL_VALUE];
const ILLEGAL_VALUE: u8 = 3;

/// Whether a fault says that there is no such address, or that it is too much at once.
pub(super) fn is_illegal(fault: Fault) -> bool {
    matches!(fault, Fault::Exception(code) if ILLEGAL.contains(&code))
}

/// A part of a block that was refused.
struct Part {
    block: Block,
    /// Why it can't be read, even alone.
    refused: Option<Fault>,
}

impl Device {
    /// Reads what can be read of a block that was refused, and learns from it.
    ///
    /// # Errors
    /// The fault of what can't be read; or another one, that ended the search.
    pub(super) async fn search(
        &self,
        block: &Block,
        fault: Fault,
        gathered: &mut Gathered,
    ) -> Result<(), Fault> {
        let mut parts = Vec::new();
        self.divide(block, fault, gathered, &mut parts).await?;
        debug_assert!(
            parts.is_sorted_by_key(|part| part.block.address)
                && parts.iter().map(|part| part.block.fields.len()).sum::<usize>()
                    == block.fields.len(),
            "the parts of a block have its fields"
        );
        let refused = parts.iter().find_map(|part| part.refused);
        if refused.is_none() && fault == Fault::Exception(ILLEGAL_VALUE) {
            // All of it can be read, only not at once.
            let most = parts.iter().map(|part| part.block.count).fold(1, u16::max);
            self.learned().lower(block.area, most);
        } else {
            for Part { block, refused } in &parts {
                if let Some(fault) = refused {
                    self.learned().refused(block, *fault);
                }
            }
            for run in parts.split(|part| part.refused.is_some()) {
                self.join(block, run).await?;
            }
        }
        self.draw_plan();
        refused.map_or(Ok(()), Err)
    }

    /// Halves a block that was refused, and what is refused of that, until one field is alone.
    async fn divide(
        &self,
        block: &Block,
        fault: Fault,
        gathered: &mut Gathered,
        parts: &mut Vec<Part>,
    ) -> Result<(), Fault> {
        let Some(halves) = plan::halves(self.fields(), block) else {
            gathered.note(block, Err(fault));
            parts.push(Part { block: block.clone(), refused: Some(fault) });
            return Ok(());
        };
        for half in halves {
            match self.ask(&half).await {
                Ok(bytes) => {
                    self.take(&half, bytes, gathered);
                    parts.push(Part { block: half, refused: None });
                }
                Err(fault) if is_illegal(fault) => {
                    Box::pin(self.divide(&half, fault, gathered, parts)).await?;
                }
                Err(other) => {
                    gathered.note(&half, Err(other));
                    return Err(other);
                }
            }
        }
        Ok(())
    }

    /// Finds out which neighbours can be read together, and cuts between the others.
    async fn join(&self, refused: &Block, run: &[Part]) -> Result<(), Fault> {
        let Some((first, others)) = run.split_first() else { return Ok(()) };
        let mut whole = first.block.clone();
        for Part { block, .. } in others {
            let joined = plan::joined(self.fields(), &whole, block);
            let together = (joined.address, joined.count) != (refused.address, refused.count)
                && match self.ask(&joined).await {
                    Ok(_) => true,
                    Err(fault) if is_illegal(fault) => false,
                    Err(other) => return Err(other),
                };
            if together {
                whole = joined;
            } else {
                self.learned().cut(block.area, block.address.into());
                whole = block.clone();
            }
        }
        Ok(())
    }
}
