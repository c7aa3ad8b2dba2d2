//! The last term of each lease that the log has had. Equal on all nodes after the same messages.

use std::collections::BTreeMap;

use bytes::Buf;
use holdfast_memory::{Refusal, Refused, Tenure, Term};

/// The most leases whose last term is known. Steps of all others are carried out.
const MAX_LEASES: usize = 65_536;

#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct LeaseTerms(BTreeMap<u64, Term>);

impl LeaseTerms {
    /// Refuses what a former holder of a lease has written, if the present one came before it in the log: a
    /// cut network delivers it late.
    pub(super) fn admit(&mut self, tenure: Option<Tenure>) -> Result<(), Refused> {
        let Some(Tenure { lease, term }) = tenure else { return Ok(()) };
        let last = self.0.get(&lease);
        if last.is_some_and(|last| term < *last) {
            return Err(Refused { index: 0, refusal: Refusal::Overtaken });
        }
        // All nodes forget the same one.
        if last.is_none() && self.0.len() == MAX_LEASES {
            self.0.pop_first();
        }
        self.0.insert(lease, term);
        Ok(())
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (u64, Term)> + '_ {
        self.0.iter().map(|(lease, term)| (*lease, *term))
    }

    pub(super) fn encode(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&(self.0.len() as u32).to_le_bytes());
        for (lease, Term { epoch, since }) in self.iter() {
            for number in [lease, epoch, since] {
                out.extend_from_slice(&number.to_le_bytes());
            }
        }
    }

    pub(super) fn decode(bytes: &mut &[u8]) -> Option<LeaseTerms> {
        let mut terms = BTreeMap::new();
        for _ in 0..bytes.try_get_u32_le().ok()? {
            let lease = bytes.try_get_u64_le().ok()?;
            let epoch = bytes.try_get_u64_le().ok()?;
            terms.insert(lease, Term { epoch, since: bytes.try_get_u64_le().ok()? });
        }
        Some(LeaseTerms(terms))
    }
}

impl FromIterator<(u64, Term)> for LeaseTerms {
    fn from_iter<T: IntoIterator<Item = (u64, Term)>>(terms: T) -> LeaseTerms {
        LeaseTerms(terms.into_iter().collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_leases_that_are_known_are_limited() {
        let mut terms = LeaseTerms::default();
        for lease in 0..MAX_LEASES as u64 + 2 {
            terms.admit(Some(Tenure { lease, term: Term::default() })).unwrap();
        }
        assert_eq!(terms.iter().map(|(lease, _)| lease).next(), Some(2));
        assert_eq!(terms.iter().count(), MAX_LEASES);
    }
}
