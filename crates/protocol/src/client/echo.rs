//! Whether a request comes back before its reply.

/// Reads in a row whose echo came before their reply, after which [`Echo::Auto`] expects one of writes too.
const MIN_ECHOES: u8 = 3;

/// Whether the adapter repeats what is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Echo {
    /// It is detected at reads. After several reads in a row with an echo, `MIN_ECHOES`, one is expected of
    /// every request; the first read without an echo ends that.
    #[default]
    Auto,
    /// Nothing counts as a reply before the echo.
    Always,
    /// What looks like an echo is not removed.
    Never,
}

impl Echo {
    /// Whether no reply comes before the echo of a request, after so many reads in a row that had one. An
    /// echo that can't be taken for the reply is recognized without this.
    pub(super) fn is_awaited(self, echoes: u8, is_unmistakable: bool) -> bool {
        match self {
            Echo::Always => true,
            Echo::Never => false,
            Echo::Auto => echoes >= MIN_ECHOES && !is_unmistakable,
        }
    }

    /// Whether the last reads had an echo, but too few of them to rely on it.
    pub(super) fn is_likely(self, echoes: u8) -> bool {
        self == Echo::Auto && (1..MIN_ECHOES).contains(&echoes)
    }
}
