//! Digests of all nodes, by sequence, and what they tell about this one.

use std::collections::BTreeMap;

/// The most sequences that are remembered of those that this node has reached; as many of the others.
const MAX_SEQUENCES: usize = 16;

#[derive(Debug)]
pub(super) struct Digests {
    node: String,
    by_sequence: BTreeMap<u64, BTreeMap<String, String>>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Verdict {
    /// No other node has published a digest of this sequence, or this node has none.
    Alone,
    Agrees,
    /// The majority has this other digest.
    Differs(String),
    /// Nodes differ, and no digest has a majority. This one is of another node.
    Unclear(String),
}

impl Digests {
    pub(super) fn new(node: &str) -> Digests {
        Digests { node: node.to_owned(), by_sequence: BTreeMap::new() }
    }

    pub(super) fn add(&mut self, node: &str, sequence: u64, digest: &str) -> Verdict {
        let digests = self.by_sequence.entry(sequence).or_default();
        digests.insert(node.to_owned(), digest.to_owned());
        let verdict = judge(digests, &self.node);
        // Counted separately, so that no sequence of another node displaces those that this node has reached.
        for is_own in [true, false] {
            let is_of = |digests: &BTreeMap<_, _>| digests.contains_key(&self.node) == is_own;
            let of = self.by_sequence.iter().filter(|(_, digests)| is_of(digests));
            let of: Vec<u64> = of.map(|(sequence, _)| *sequence).collect();
            for sequence in &of[..of.len().saturating_sub(MAX_SEQUENCES)] {
                self.by_sequence.remove(sequence);
            }
        }
        verdict
    }

    pub(super) fn own(&self, sequence: u64) -> Option<&str> {
        self.by_sequence.get(&sequence)?.get(&self.node).map(String::as_str)
    }

    /// The last sequence of which this node has a digest.
    pub(super) fn last_own(&self) -> Option<u64> {
        let mut last_first = self.by_sequence.iter().rev();
        last_first.find(|(_, digests)| digests.contains_key(&self.node)).map(|(at, _)| *at)
    }
}

fn judge(digests: &BTreeMap<String, String>, node: &str) -> Verdict {
    let Some(own) = digests.get(node) else { return Verdict::Alone };
    let votes = |digest: &str| digests.values().filter(|other| *other == digest).count();
    let other = digests.values().filter(|other| *other != own).max_by_key(|other| votes(other));
    match other {
        None if digests.len() == 1 => Verdict::Alone,
        None => Verdict::Agrees,
        // A tie is not a majority: of two nodes, each may be the wrong one.
        Some(_) if 2 * votes(own) > digests.len() => Verdict::Agrees,
        Some(other) if 2 * votes(other) > digests.len() => Verdict::Differs(other.clone()),
        Some(other) => Verdict::Unclear(other.clone()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(published: &[(&str, &str)]) -> Verdict {
        let mut digests = Digests::new("a");
        let verdicts = published.iter().map(|(node, digest)| digests.add(node, 10, digest));
        verdicts.last().unwrap()
    }

    #[test]
    fn a_majority_decides() {
        assert_eq!(verdict(&[("a", "1")]), Verdict::Alone);
        assert_eq!(verdict(&[("b", "1"), ("c", "2")]), Verdict::Alone);
        assert_eq!(verdict(&[("a", "1"), ("b", "1")]), Verdict::Agrees);
        assert_eq!(verdict(&[("a", "1"), ("b", "2")]), Verdict::Unclear("2".to_owned()));
        assert_eq!(
            verdict(&[("a", "1"), ("b", "2"), ("c", "2")]),
            Verdict::Differs("2".to_owned())
        );
        assert_eq!(
            verdict(&[("b", "2"), ("c", "2"), ("a", "1")]),
            Verdict::Differs("2".to_owned())
        );
        assert_eq!(verdict(&[("a", "1"), ("b", "2"), ("c", "1")]), Verdict::Agrees);
        let three = verdict(&[("a", "1"), ("b", "2"), ("c", "3")]);
        assert!(matches!(three, Verdict::Unclear(_)), "{three:?}");
    }

    #[test]
    fn old_sequences_are_forgotten() {
        let mut digests = Digests::new("a");
        for sequence in 0..1000 {
            digests.add("b", 1_000_000 + sequence, "1");
            digests.add("a", sequence, "1");
        }
        assert_eq!(digests.by_sequence.len(), 2 * MAX_SEQUENCES);
        assert_eq!(digests.own(999), Some("1"));
        assert_eq!(digests.own(983), None);
        assert_eq!(digests.last_own(), Some(999));
    }
}
