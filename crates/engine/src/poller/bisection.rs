//! Bisects a refused block until each unreadable field is isolated, then merges what the device
//! accepts. The search costs a few requests, once.

use super::device::{Device, Gathered};
use super::plan::{self, Block};
use crate::link::Fault;

/// Exceptions that depend on the request, not on the state of the device.
const ILLEGAL: [u8; 2] = [2, ILLEGAL_VALUE];
const ILLEGAL_VALUE: u8 = 3;

impl Fault {
    /// Whether it means that an address does not exist, or that the request is too large.
    pub(super) fn is_illegal(self) -> bool {
        matches!(self, Fault::Exception(code) if ILLEGAL.contains(&code))
    }
}

/// A part of a refused block.
struct Part {
    block: Block,
    /// The fault if the part cannot be read, even alone.
    refused: Option<Fault>,
}

impl Device {
    /// Reads the readable fields of a refused block, and remembers the others.
    ///
    /// # Errors
    /// The fault of an unreadable field, or another fault that ended the search.
    pub(super) async fn search(
        &self,
        gathered: &mut Gathered,
        block: &Block,
        fault: Fault,
    ) -> Result<(), Fault> {
        let mut parts = Vec::new();
        divide(self, gathered, block, fault, &mut parts).await?;
        debug_assert!(
            parts.is_sorted_by_key(|part| part.block.address)
                && parts.iter().map(|part| part.block.fields.len()).sum::<usize>()
                    == block.fields.len(),
            "the parts of a block have its fields"
        );
        let refused = parts.iter().find_map(|part| part.refused);
        if refused.is_none() && fault == Fault::Exception(ILLEGAL_VALUE) {
            // All parts can be read, but not in one request.
            let most = parts.iter().map(|part| part.block.count).fold(1, u16::max);
            self.learned().lower(block.area, most);
        } else {
            for Part { block, refused } in &parts {
                if let Some(fault) = refused {
                    self.learned().refused(block, *fault);
                }
            }
            for run in parts.split(|part| part.refused.is_some()) {
                if let Err(fault) = join(self, block, run).await {
                    // Otherwise the next poll would search again for what is known now.
                    self.draw_plan();
                    return Err(fault);
                }
            }
        }
        self.draw_plan();
        refused.map_or(Ok(()), Err)
    }
}

/// Halves a refused block recursively, until one field, or several equal ones, are left.
async fn divide(
    device: &Device,
    gathered: &mut Gathered,
    block: &Block,
    fault: Fault,
    parts: &mut Vec<Part>,
) -> Result<(), Fault> {
    let Some(halves) = plan::halves(&device.fields, block) else {
        gathered.note(block.range(), Err(fault));
        parts.push(Part { block: block.clone(), refused: Some(fault) });
        return Ok(());
    };
    for half in halves {
        match device.ask(half.range()).await {
            Ok(bytes) => {
                device.take(&half, bytes, gathered);
                parts.push(Part { block: half, refused: None });
            }
            Err(fault) if fault.is_illegal() => {
                Box::pin(divide(device, gathered, &half, fault, parts)).await?;
            }
            Err(other) => {
                gathered.note(half.range(), Err(other));
                return Err(other);
            }
        }
    }
    Ok(())
}

/// Finds which neighbours can be read together, and adds cuts between the others. No cut divides
/// overlapping ones: their block is longer than the device accepts.
async fn join(device: &Device, refused: &Block, run: &[Part]) -> Result<(), Fault> {
    let Some((first, others)) = run.split_first() else { return Ok(()) };
    let mut whole = first.block.clone();
    let apart = |joined: &Block, whole: &Block, block: &Block| {
        let mut learned = device.learned();
        if joined.count < whole.count + block.count {
            learned.lower(block.area, whole.count.max(block.count));
        } else {
            learned.cut(block.area, block.address.into());
        }
    };
    for Part { block, .. } in others {
        let joined = plan::joined(&device.fields, &whole, block);
        let together = (joined.address, joined.count) != (refused.address, refused.count)
            && match device.ask(joined.range()).await {
                Ok(_) => true,
                Err(fault) if fault.is_illegal() => false,
                Err(other) => {
                    // They were answered apart, so they are read apart.
                    apart(&joined, &whole, block);
                    return Err(other);
                }
            };
        if together {
            whole = joined;
        } else {
            apart(&joined, &whole, block);
            whole = block.clone();
        }
    }
    Ok(())
}
