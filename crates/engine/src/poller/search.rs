//! What becomes of a block that a device refuses: it is halved until what can't be read is alone, and
//! then put together again as far as the device bears. That takes a few requests, once.

use std::cell::RefMut;

use super::learned::Learned;
use super::plan::{self, Block, Field};
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

/// What a search needs of a device.
pub(super) trait Searched {
    /// The parts of reads that one request can carry.
    fn fields(&self) -> &[Field];

    /// What is known of the device, which a search adds to.
    fn learned(&self) -> RefMut<'_, Learned>;

    /// Draws the plan from what is known.
    fn draw_plan(&self);

    /// Reads a block, with one request.
    async fn ask(&self, block: &Block) -> Result<Vec<u8>, Fault>;

    /// Hands on what a block brought.
    fn take(&mut self, block: &Block, bytes: Vec<u8>);

    /// Notes that a block brought nothing.
    fn note(&mut self, block: &Block, fault: Fault);
}

/// Reads what can be read of a block that was refused, and learns from it.
///
/// # Errors
/// The fault of what can't be read; or another one, that ended the search.
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
        // All of it can be read, only not at once.
        let most = parts.iter().map(|part| part.block.count).fold(1, u16::max);
        device.learned().lower(block.area, most);
    } else {
        for Part { block, refused } in &parts {
            if let Some(fault) = refused {
                device.learned().refused(block, *fault);
            }
        }
        for run in parts.split(|part| part.refused.is_some()) {
            join(device, block, run).await?;
        }
    }
    device.draw_plan();
    refused.map_or(Ok(()), Err)
}

/// Halves a block that was refused, and what is refused of that, until one field is alone.
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

/// Finds out which neighbours can be read together, and cuts between the others.
async fn join(device: &impl Searched, refused: &Block, run: &[Part]) -> Result<(), Fault> {
    let Some((first, others)) = run.split_first() else { return Ok(()) };
    let mut whole = first.block.clone();
    for Part { block, .. } in others {
        let joined = plan::joined(device.fields(), &whole, block);
        let together = (joined.address, joined.count) != (refused.address, refused.count)
            && match device.ask(&joined).await {
                Ok(_) => true,
                Err(fault) if is_illegal(fault) => false,
                Err(other) => return Err(other),
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
