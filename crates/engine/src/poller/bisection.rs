//! Bisects a refused block until each unreadable field is isolated, then merges what the device
//! accepts. The search costs a few requests, once.

use std::cell::RefMut;

use super::learned_limits::Learned;
use super::plan::{self, Block, Field};
use crate::link::Fault;

/// Exceptions that depend on the request, not on the state of the device.
const ILLEGAL: [u8; 2] = [2, ILLEGAL_VALUE];
const ILLEGAL_VALUE: u8 = 3;

/// Whether a fault means that an address does not exist, or that the request is too large.
pub(super) fn is_illegal(fault: Fault) -> bool {
    matches!(fault, Fault::Exception(code) if ILLEGAL.contains(&code))
}

/// A part of a refused block.
struct Part {
    block: Block,
    /// The fault if the part cannot be read, even alone.
    refused: Option<Fault>,
}

/// The operations of a device that a search uses.
pub(super) trait Searched {
    /// The parts of reads. Each fits into one request.
    fn fields(&self) -> &[Field];

    /// What the device has taught, which a search adds to.
    fn learned(&self) -> RefMut<'_, Learned>;

    /// Plans again from what has been learned.
    fn draw_plan(&self);

    /// Reads a block with one request.
    async fn ask(&self, block: &Block) -> Result<Vec<u8>, Fault>;

    /// Passes on the bytes of a block.
    fn take(&mut self, block: &Block, bytes: Vec<u8>);

    /// Records the fault of a block.
    fn note(&mut self, block: &Block, fault: Fault);
}

/// Reads the readable fields of a refused block, and remembers the others.
///
/// # Errors
/// The fault of an unreadable field, or another fault that ended the search.
pub(super) async fn search(
    device: &mut impl Searched,
    block: &Block,
    fault: Fault,
) -> Result<(), Fault> {
    let mut parts = Vec::new();
    divide(device, block, fault, &mut parts).await?;
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
        device.learned().lower(block.area, most);
    } else {
        for Part { block, refused } in &parts {
            if let Some(fault) = refused {
                device.learned().refused(block, *fault);
            }
        }
        for run in parts.split(|part| part.refused.is_some()) {
            if let Err(fault) = join(device, block, run).await {
                // Otherwise the next poll would search again for what is known now.
                device.draw_plan();
                return Err(fault);
            }
        }
    }
    device.draw_plan();
    refused.map_or(Ok(()), Err)
}

/// Halves a refused block recursively, until one field is left.
async fn divide(
    device: &mut impl Searched,
    block: &Block,
    fault: Fault,
    parts: &mut Vec<Part>,
) -> Result<(), Fault> {
    let Some(halves) = plan::halves(device.fields(), block) else {
        device.note(block, fault);
        parts.push(Part { block: block.clone(), refused: Some(fault) });
        return Ok(());
    };
    for half in halves {
        match device.ask(&half).await {
            Ok(bytes) => {
                device.take(&half, bytes);
                parts.push(Part { block: half, refused: None });
            }
            Err(fault) if is_illegal(fault) => {
                Box::pin(divide(device, &half, fault, parts)).await?;
            }
            Err(other) => {
                device.note(&half, other);
                return Err(other);
            }
        }
    }
    Ok(())
}

/// Finds which neighbours can be read together, and adds cuts between the others.
async fn join(device: &impl Searched, refused: &Block, run: &[Part]) -> Result<(), Fault> {
    let Some((first, others)) = run.split_first() else { return Ok(()) };
    let mut whole = first.block.clone();
    for Part { block, .. } in others {
        let joined = plan::joined(device.fields(), &whole, block);
        let together = (joined.address, joined.count) != (refused.address, refused.count)
            && match device.ask(&joined).await {
                Ok(_) => true,
                Err(fault) if is_illegal(fault) => false,
                Err(other) => {
                    // They were answered apart, so they are read apart.
                    device.learned().cut(block.area, block.address.into());
                    return Err(other);
                }
            };
        if together {
            whole = joined;
        } else {
            device.learned().cut(block.area, block.address.into());
            whole = block.clone();
        }
    }
    Ok(())
}
