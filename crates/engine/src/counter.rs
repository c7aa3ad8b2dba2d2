//! Counters.

use std::collections::BTreeMap;
use std::sync::Mutex;

use holdfast_runtime::lock;

/// Makes a struct of counters with a list of their names. Fields after the semicolon are not in the
/// list.
macro_rules! counters {
    (
        $(#[$meta:meta])*
        pub struct $name:ident {
            $($(#[$about:meta])* $counter:ident,)*
            $(; $($(#[$other_about:meta])* $access:vis $other:ident: $type:ty,)*)?
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Default)]
        pub struct $name {
            $($(#[$about])* pub $counter: holdfast_runtime::Counter,)*
            $($($(#[$other_about])* $access $other: $type,)*)?
        }

        impl $name {
            /// The names of the counters, each with its count.
            pub fn by_name(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
                [$((stringify!($counter), self.$counter.get())),*].into_iter()
            }
        }
    };
}
pub(crate) use counters;

/// A counter for each reason. Reasons are constants in the code, so the map stays small.
#[derive(Debug, Default)]
pub struct ReasonCounters(Mutex<BTreeMap<&'static str, u64>>);

impl ReasonCounters {
    pub fn add(&self, reason: &'static str) {
        *lock(&self.0).entry(reason).or_default() += 1;
    }

    /// The counts by reason. Reasons that did not occur are left out.
    pub fn by_reason(&self) -> BTreeMap<&'static str, u64> {
        lock(&self.0).clone()
    }

    pub fn total(&self) -> u64 {
        self.by_reason().values().sum()
    }
}
