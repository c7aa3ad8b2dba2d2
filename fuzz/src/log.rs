//! Messages of a log, as its stream holds them: [length of a snapshot] the snapshot,
//! messages.

use std::sync::Arc;

use holdfast_journal::log::replica::{Replica, again};
use holdfast_memory::Memory;

/// A message is the encoding of its parts. A node that begins with a snapshot has the same contents as one that
/// has applied all messages. A snapshot that is not loaded changes nothing.
pub fn check(data: &[u8]) {
    let Some((len, rest)) = data.split_first_chunk() else { return };
    let (snapshot, messages) = rest.split_at(rest.len().min(u16::from_be_bytes(*len).into()));
    let mut nodes = [0; 2].map(|_| Replica::new(crate::step::members().to_vec()));
    let half = messages.len() / 2;
    let mut sequence = 0;
    let mut rest = messages;
    while !rest.is_empty() {
        let (message, behind) = crate::counted(rest);
        let members: [Arc<Memory>; 2] = crate::step::members();
        if let Some(bytes) = again(message, &members) {
            assert_eq!(bytes, message);
        }
        if behind.len() < half && rest.len() >= half {
            let taken = nodes[0].encode();
            nodes[1].load(&taken, sequence).expect("the snapshot of a node");
            assert_eq!(nodes[1].encode(), taken);
        }
        let applied = nodes[0].apply(message);
        if behind.len() < half {
            assert_eq!(nodes[1].apply(message), applied);
            assert_eq!(nodes[1].encode(), nodes[0].encode());
        }
        sequence += u64::from(applied.is_ok());
        rest = behind;
    }
    let [node, other] = &mut nodes;
    let before = node.encode();
    if node.load(snapshot, 1).is_err() {
        return assert_eq!(node.encode(), before, "nothing has changed");
    }
    let loaded = node.encode();
    other.load(&loaded, 1).expect("what was encoded");
    assert_eq!(other.encode(), loaded);
}
