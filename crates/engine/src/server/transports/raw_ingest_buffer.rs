//! The bytes of packets that have not arrived completely.
//!
//! A connection holds what its peer has sent, not what a header announces. Long packets are kept in
//! pages of their own: the system gets them back as soon as the packet is written or given up, whatever
//! the allocator does with the memory of others. A worker keeps a few of them for the next packets.

use std::cell::RefCell;
use std::mem;
use std::ops::Deref;
use std::sync::Arc;
use std::task::{Context, Poll};

use memmap2::MmapMut;

use crate::server::reports::counters::PacketCounters;
use crate::server::transports::stream::{End, Stream};

/// The longest packet: a header of 12 bytes, 65,535 registers and a CRC.
const MAX_PACKET_BYTES: usize = 12 + 2 * 65_535 + 4;

/// The most bytes that a connection holds: a packet, and what arrives with its end.
pub(crate) const MAX_HELD_BYTES: usize = 144 * 1024;

/// The most bytes that are kept without pages of their own.
const SHORT_BYTES: usize = 2048;

/// The most unused pages that a worker keeps, for the next long packets: the system takes longer to
/// provide pages than to copy a packet.
const MAX_UNUSED_PAGES: usize = 16;

/// Bytes per read while few bytes are held.
const CHUNK_BYTES: usize = 16 * 1024;

const _: () = assert!(
    MAX_PACKET_BYTES + SHORT_BYTES < MAX_HELD_BYTES && SHORT_BYTES + CHUNK_BYTES < MAX_HELD_BYTES
);

thread_local! {
    /// Input of connections that hold few bytes, shared by all of a worker.
    static SCRATCH: RefCell<Box<[u8]>> = RefCell::new(vec![0; CHUNK_BYTES].into_boxed_slice());
    static UNUSED: RefCell<Vec<MmapMut>> = const { RefCell::new(Vec::new()) };
}

/// Bytes that were received and not processed.
pub(crate) struct Incoming {
    held: Held,
    /// What `counters` has of it.
    counted: usize,
    counters: Arc<PacketCounters>,
}

enum Held {
    Few(Vec<u8>),
    /// The pages, how many of their bytes are in use, and how many were ever.
    Many {
        pages: MmapMut,
        len: usize,
        touched: usize,
    },
}

impl Incoming {
    pub(crate) fn new(counters: Arc<PacketCounters>) -> Incoming {
        Incoming { held: Held::Few(Vec::new()), counted: 0, counters }
    }

    /// Reads once, at most about `most` bytes. Returns the number of bytes that were added. Before it
    /// waits, it gives back the memory that is not required.
    pub(crate) fn poll_read<S: Stream>(
        &mut self,
        context: &mut Context<'_>,
        (stream, unsent): (&mut S, &mut Vec<u8>),
        most: usize,
    ) -> Poll<Result<usize, End>> {
        let read = match &mut self.held {
            Held::Many { pages, len, .. } if *len < pages.len() => {
                let end = len.saturating_add(most).min(pages.len());
                let read = stream.poll_read(context, &mut pages[*len..end], unsent);
                if let Poll::Ready(Ok(count)) = read {
                    self.grow(count);
                }
                read
            }
            _ => SCRATCH.with_borrow_mut(|scratch| {
                let input = &mut scratch[..most.min(CHUNK_BYTES)];
                let read = stream.poll_read(context, input, unsent);
                if let Poll::Ready(Ok(count)) = read {
                    self.extend(&input[..count]);
                }
                read
            }),
        };
        if read.is_pending() {
            self.shrink();
        }
        read
    }

    /// Appends bytes.
    pub(crate) fn extend(&mut self, bytes: &[u8]) {
        let total = self.len() + bytes.len();
        if let Held::Many { pages, len, .. } = &mut self.held
            && total <= pages.len()
        {
            pages[*len..total].copy_from_slice(bytes);
            return self.grow(bytes.len());
        }
        if total > SHORT_BYTES
            && total <= MAX_HELD_BYTES
            && let Held::Few(few) = &self.held
            && let Some(mut pages) = pages()
        {
            let len = few.len();
            pages[..len].copy_from_slice(few);
            self.replace(Held::Many { pages, len, touched: len });
            return self.extend(bytes);
        }
        // Also when the system has no pages.
        let mut few = match &mut self.held {
            Held::Few(few) => mem::take(few),
            Held::Many { .. } => self.to_vec(),
        };
        few.extend_from_slice(bytes);
        self.replace(Held::Few(few));
    }

    /// Removes bytes from the start.
    pub(crate) fn consume(&mut self, count: usize) {
        match &mut self.held {
            Held::Few(few) => drop(few.drain(..count)),
            Held::Many { pages, len, .. } => {
                pages.copy_within(count..*len, 0);
                *len -= count;
            }
        }
    }

    /// Drops all bytes, and gives back their memory.
    pub(crate) fn clear(&mut self) {
        self.replace(Held::Few(Vec::new()));
    }

    fn replace(&mut self, held: Held) {
        if let Held::Many { pages, .. } = mem::replace(&mut self.held, held) {
            // A thread that ends has no room for them any more.
            let _ = UNUSED.try_with(|unused| {
                let mut unused = unused.borrow_mut();
                if unused.len() < MAX_UNUSED_PAGES {
                    unused.push(pages);
                }
            });
        }
        self.count();
    }

    /// Counts bytes that were appended to the pages.
    fn grow(&mut self, count: usize) {
        if let Held::Many { len, touched, .. } = &mut self.held {
            *len += count;
            *touched = (*touched).max(*len);
        }
        self.count();
    }

    /// Tells the listener how much memory this is.
    fn count(&mut self) {
        let now = match &self.held {
            Held::Few(few) => few.capacity(),
            Held::Many { touched, .. } => *touched,
        };
        self.counters.held_bytes.add_many(now as u64);
        self.counters.held_bytes.subtract(self.counted as u64);
        self.counted = now;
    }

    /// Gives back memory that few bytes are in.
    fn shrink(&mut self) {
        let room = match &self.held {
            Held::Few(few) => few.capacity(),
            Held::Many { pages, .. } => pages.len(),
        };
        if self.is_empty() && room > 0 {
            self.clear();
        } else if self.len() <= SHORT_BYTES && room > 2 * SHORT_BYTES {
            self.replace(Held::Few(self.to_vec()));
        }
    }
}

/// Pages for a long packet; `None` if the system has none.
fn pages() -> Option<MmapMut> {
    let unused = UNUSED.with_borrow_mut(Vec::pop);
    unused.or_else(|| MmapMut::map_anon(MAX_HELD_BYTES).ok())
}

impl Deref for Incoming {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match &self.held {
            Held::Few(few) => few,
            Held::Many { pages, len, .. } => &pages[..*len],
        }
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        self.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn incoming() -> (Incoming, Arc<PacketCounters>) {
        let counters = Arc::new(PacketCounters::default());
        (Incoming::new(Arc::clone(&counters)), counters)
    }

    #[test]
    fn bytes_keep_their_order_through_every_size() {
        let (mut incoming, counters) = incoming();
        let sent: Vec<u8> = (0..MAX_PACKET_BYTES).map(|at| (at % 251) as u8).collect();
        for piece in sent.chunks(777) {
            incoming.extend(piece);
            assert!(counters.held_bytes.get() <= (incoming.len() + SHORT_BYTES) as u64);
        }
        assert_eq!(*incoming, *sent);
        incoming.consume(MAX_PACKET_BYTES - 5);
        assert_eq!(*incoming, sent[MAX_PACKET_BYTES - 5..]);
        incoming.shrink();
        assert_eq!(*incoming, sent[MAX_PACKET_BYTES - 5..]);
        assert!(counters.held_bytes.get() <= SHORT_BYTES as u64);
        incoming.extend(&sent);
        assert_eq!(incoming[5..], *sent);
        drop(incoming);
        assert_eq!(counters.held_bytes.get(), 0);
    }

    #[test]
    fn nothing_is_lost_beyond_the_room() {
        let (mut incoming, counters) = incoming();
        incoming.extend(&[7; MAX_HELD_BYTES]);
        incoming.extend(&[8]);
        assert_eq!(
            (incoming.len(), incoming[MAX_HELD_BYTES - 1], incoming[MAX_HELD_BYTES]),
            (MAX_HELD_BYTES + 1, 7, 8)
        );
        incoming.consume(MAX_HELD_BYTES);
        incoming.shrink();
        assert_eq!(*incoming, [8]);
        assert!(counters.held_bytes.get() <= SHORT_BYTES as u64);
    }
}
