//! One write to several memories: by their journal, or under the locks of all of them.

use std::ptr;
use std::sync::{Arc, RwLockWriteGuard};

use crate::error::{Refusal, Refused};
use crate::memory::checks::{Ranges, check_across, check_each};
use crate::memory::{Content, Memory, Writer};
use crate::operation::{Access, Write};
use crate::runs::{self, Run};
use crate::step::{Action, Done, Journal, Step, StepWrite, wait};

/// The access of a batch of data, by whether each of its writes is granted only while its memory is sealed. A batch is
/// one step, so one such write requires a seal of all memories.
pub fn access_of(restores: impl IntoIterator<Item = bool>) -> Access {
    if restores.into_iter().any(|restores| restores) { Access::Restore } else { Access::Ingest }
}

/// Writes to several memories atomically: no reader sees some of the writes without the others, and
/// when one write is refused, none is carried out. Several writes can name the same memory. Returns the
/// sequence of the step, if a log has carried it out.
///
/// # Errors
/// `WrongLength`, `OutOfRange` or `GateBit`, with the index of the first write that fails one of
/// these checks. Then [`Refusal::NotOneStep`] where a memory has another journal than the first, and
/// [`Refusal::Sealed`] (for a client), with the index of the first write to a sealed memory, or
/// [`Refusal::Unsealed`] (for [`Access::Restore`]), with that of the first one to another memory. Nothing
/// has changed then. If the memories have a journal, see also [`Journal::submit`].
pub fn write_across(
    access: Access,
    writes: &[(&Memory, Write<'_>)],
) -> Result<Option<u64>, Refused> {
    if writes.iter().any(|(memory, _)| memory.has_journal()) {
        let submit = |done| {
            submit_across(access, writes, done);
            Ok(())
        };
        return wait(submit).map(|done| done.sequence);
    }
    check_across(access, writes)?;
    write_checked(Writer::now(access), writes).map(|()| None)
}

/// As [`write_across`], by the journal of the memories, without waiting for it. `done` gets all errors. It
/// is called from any thread, also before this returns.
#[cold]
pub fn submit_across(access: Access, writes: &[(&Memory, Write<'_>)], done: Done) {
    match step_across(access, writes) {
        Ok((journal, step)) => journal.submit(step, done),
        Err(refused) => done(Err(refused)),
    }
}

/// As [`write_across`], by a journal.
pub(crate) fn carry_out_across(
    writer: Writer,
    writes: &[(&Memory, Write<'_>)],
) -> Result<(), Refused> {
    check_each(writer.access, writes.iter().map(|(memory, write)| (*memory, write)), Ranges::All)?;
    write_checked(writer, writes)
}

/// The writes as one step, and the journal that carries it out.
fn step_across<'m>(
    access: Access,
    writes: &[(&'m Memory, Write<'_>)],
) -> Result<(&'m dyn Journal, Step), Refused> {
    check_across(access, writes)?;
    let Some((journal, _)) = writes.first().and_then(|(memory, _)| memory.journal.get()) else {
        return Err(Refused { index: 0, refusal: Refusal::NotOneStep });
    };
    let mut step = Vec::with_capacity(writes.len());
    for (index, (memory, write)) in writes.iter().enumerate() {
        let place = memory.journal.get().filter(|(other, _)| Arc::ptr_eq(other, journal));
        let refused = |refusal| Refused { index, refusal };
        let (_, member) = place.ok_or(refused(Refusal::NotOneStep))?;
        memory.admit(&memory.shared(), access).map_err(refused)?;
        step.push(StepWrite::new(*member, write));
    }
    Ok((&**journal, Step { access, tenure: None, action: Action::Write(step) }))
}

fn write_checked(writer: Writer, writes: &[(&Memory, Write<'_>)]) -> Result<(), Refused> {
    let mut placed: Vec<Placed> = writes
        .iter()
        .enumerate()
        .map(|(index, &(memory, write))| Placed { index, memory, write })
        .collect();
    // The sort is stable: writes to one area of one memory keep their order.
    placed.sort_by_key(|placed| (placed.memory.rank, placed.write.area));
    if !runs::is_large(placed.iter().map(|placed| &placed.write)) {
        return apply_across(writer, &placed);
    }
    let flat: Vec<(&Placed, Vec<Run>)> = placed
        .chunk_by(|a, b| ptr::eq(a.memory, b.memory) && a.write.area == b.write.area)
        .map(|writes| (&writes[0], runs::flatten(writes.iter().map(|placed| &placed.write))))
        .collect();
    let runs: Vec<Placed> = flat
        .iter()
        .flat_map(|(first, runs)| {
            runs.iter().map(|run| Placed { write: run.writing(first.write.area), ..**first })
        })
        .collect();
    apply_across(writer, &runs)
}

/// A write that has been checked, with the memory it was checked for.
struct Placed<'a> {
    /// The index in the batch. A run has the index of its first write.
    index: usize,
    memory: &'a Memory,
    write: Write<'a>,
}

/// A locked memory and the writes to it.
struct Target<'p, 'a> {
    memory: &'a Memory,
    content: RwLockWriteGuard<'a, Content>,
    writes: &'p [Placed<'a>],
}

/// Carries out writes to several memories. The writes are sorted by the rank of their memory.
fn apply_across(writer: Writer, placed: &[Placed<'_>]) -> Result<(), Refused> {
    debug_assert!(
        placed.is_sorted_by_key(|placed| placed.memory.rank),
        "locks are taken in rank order"
    );
    let by_memory = placed.chunk_by(|a, b| ptr::eq(a.memory, b.memory));
    let mut targets: Vec<Target> = by_memory
        .map(|writes| {
            let memory = writes[0].memory;
            Target { memory, content: memory.exclusive(), writes }
        })
        .collect();
    debug_assert!(
        targets.is_sorted_by(|a, b| a.memory.rank < b.memory.rank),
        "each lock is taken once"
    );
    let refused = targets.iter().filter_map(|target| {
        let refusal = target.content.admit(writer.access).err()?;
        let indexes = target.writes.iter().map(|placed| placed.index);
        Some(Refused { index: indexes.fold(usize::MAX, usize::min), refusal })
    });
    if let Some(first) = refused.min_by_key(|refused| refused.index) {
        return Err(first);
    }
    for Target { memory, content, writes } in &mut targets {
        memory.apply(writer, content, writes.iter().map(|placed| &placed.write));
    }
    Ok(())
}
