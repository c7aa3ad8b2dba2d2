//! Which received bytes belong to the current request. hyper judges whether they are valid; here, only
//! their end matters.

/// The largest header of a request, in bytes.
pub(super) const MAX_HEADER_BYTES: usize = 65_536;

/// The part of a request that is still to be read.
#[derive(Debug)]
pub(super) enum Portion {
    /// Its header.
    Head(HeadEnd),
    /// The rest of a body with a length: this many bytes.
    Body(u64),
    /// The rest of a body in chunks.
    Chunks(ChunksEnd),
}

impl Portion {
    /// How many of these bytes hyper may read now: those of this request, but none of a header
    /// until it is complete. `bytes` are those of the call before that were not
    /// [skipped](Portion::skip), and more.
    pub(super) fn len(&mut self, bytes: &[u8]) -> usize {
        match self {
            Portion::Head(end) => end.find(bytes),
            Portion::Body(left) => bytes.len().min(usize::try_from(*left).unwrap_or(usize::MAX)),
            Portion::Chunks(end) => end.find(bytes),
        }
    }

    /// Leaves out the first bytes, which hyper has read.
    pub(super) fn skip(&mut self, len: usize) {
        match self {
            Portion::Head(end) => {
                end.is_begun |= len > 0;
                end.search.skip(len);
            }
            Portion::Body(left) => *left -= len as u64,
            Portion::Chunks(end) => end.search.skip(len),
        }
    }

    /// Whether hyper has read a whole header and still waits for its end.
    pub(super) fn hyper_missed_end(&self) -> bool {
        matches!(self, Portion::Head(end) if end.search.found == Some(0))
    }

    /// Whether all of the request has been read.
    pub(super) fn is_over(&self) -> bool {
        match self {
            Portion::Head(_) => false,
            Portion::Body(left) => *left == 0,
            Portion::Chunks(end) => end.is_over && end.search.found == Some(0),
        }
    }
}

/// How far bytes were searched, and where the end was found.
#[derive(Debug, Default)]
struct Search {
    searched: usize,
    found: Option<usize>,
}

impl Search {
    fn skip(&mut self, len: usize) {
        self.searched = self.searched.saturating_sub(len);
        self.found = self.found.map(|found| found - len);
    }
}

/// Finds the end of a header: an empty line. CRs are ignored.
#[derive(Debug, Default)]
pub(super) struct HeadEnd {
    search: Search,
    /// The beginning of the line, in lower case, without CR.
    line: Vec<u8>,
    has_lines: bool,
    has_length: bool,
    /// How many lines name a coding.
    codings: usize,
    /// Whether one of them names another than the chunks alone.
    has_other_coding: bool,
    /// Whether hyper has read a part of it.
    is_begun: bool,
}

const LENGTH: &[u8] = b"content-length:";
const CODING: &[u8] = b"transfer-encoding:";

/// The beginning of a line that is kept: enough for the name and value of a coding.
const KEPT_LINE_BYTES: usize = CODING.len() + 32;

impl HeadEnd {
    fn find(&mut self, bytes: &[u8]) -> usize {
        while self.search.found.is_none()
            && let Some(byte) = bytes.get(self.search.searched)
        {
            self.search.searched += 1;
            match byte {
                // Empty lines before a request belong to it.
                b'\n' if self.line.is_empty() && !self.has_lines => {}
                b'\n' if self.line.is_empty() => self.search.found = Some(self.search.searched),
                b'\n' => self.end_line(),
                b'\r' => {}
                _ if self.line.len() < KEPT_LINE_BYTES => self.line.push(byte.to_ascii_lowercase()),
                _ => {}
            }
        }
        match self.search.found {
            Some(found) => found,
            None if self.is_held_back(bytes) => 0,
            None => bytes.len(),
        }
    }

    /// Whether a header is held back until it is complete: of a part, hyper looks for the end by
    /// other rules. Not if hyper has begun to read it; nor if it is too large, or its first byte
    /// can't begin a request: hyper then refuses it at once.
    fn is_held_back(&self, bytes: &[u8]) -> bool {
        let first = bytes.iter().find(|byte| !matches!(byte, b'\r' | b'\n'));
        !self.is_begun && bytes.len() <= MAX_HEADER_BYTES && first.is_none_or(u8::is_ascii_graphic)
    }

    fn end_line(&mut self) {
        self.has_lines = true;
        self.has_length |= self.line.starts_with(LENGTH);
        if let Some(coding) = self.line.strip_prefix(CODING) {
            self.codings += 1;
            self.has_other_coding |= coding.trim_ascii() != b"chunked";
        }
        self.line.clear();
    }

    /// Whether the header has both Content-Length and Transfer-Encoding, or another coding than the chunks alone.
    /// hyper would accept it, but proxies disagree about its end: request smuggling (RFC 9112, 6.1 and 11.2).
    pub(super) fn is_ambiguous(&self) -> bool {
        self.has_length && self.codings > 0 || self.codings > 1 || self.has_other_coding
    }
}

/// Finds the end of a body in chunks (RFC 9112, 7.1).
#[derive(Debug, Default)]
pub(super) struct ChunksEnd {
    search: Search,
    part: Part,
    is_over: bool,
}

#[derive(Debug, Clone, Copy)]
enum Part {
    /// The size of a chunk, so far.
    Size(u64),
    /// What follows the size in its line.
    Extension(u64),
    /// Data, and the line end after it.
    Data(u64),
    /// A line of the trailer: its length so far, and whether a CR was last. For hyper, only CR and LF end it.
    Trailer(usize, bool),
}

impl Default for Part {
    fn default() -> Part {
        Part::Size(0)
    }
}

impl ChunksEnd {
    fn find(&mut self, bytes: &[u8]) -> usize {
        while self.search.found.is_none() && self.search.searched < bytes.len() {
            let rest = &bytes[self.search.searched..];
            self.search.searched += self.pass(rest);
            if self.is_over {
                self.search.found = Some(self.search.searched);
            }
        }
        self.search.found.unwrap_or(bytes.len())
    }

    /// Passes at least one byte. Returns how many.
    fn pass(&mut self, bytes: &[u8]) -> usize {
        const LINE_END: u64 = 2;
        let byte = bytes[0];
        self.part = match self.part {
            Part::Data(left) => {
                let passed = bytes.len().min(usize::try_from(left).unwrap_or(usize::MAX));
                let left = left - passed as u64;
                self.part = if left == 0 { Part::Size(0) } else { Part::Data(left) };
                return passed;
            }
            Part::Size(size) | Part::Extension(size) if byte == b'\n' => match size {
                0 => Part::Trailer(0, false),
                size => Part::Data(size.saturating_add(LINE_END)),
            },
            Part::Size(size) => match char::from(byte).to_digit(16) {
                Some(digit) => Part::Size(size.saturating_mul(16).saturating_add(digit.into())),
                None => Part::Extension(size),
            },
            Part::Extension(size) => Part::Extension(size),
            Part::Trailer(len, was_cr) => match byte {
                b'\n' if was_cr => {
                    self.is_over = len == 0;
                    Part::Trailer(0, false)
                }
                b'\r' => Part::Trailer(len, true),
                _ => Part::Trailer(len + 1, false),
            },
        };
        1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Passes the bytes cut in two at every place. Returns how many belong to the request.
    fn ends(portion: impl Fn() -> Portion, bytes: &[u8]) -> usize {
        let mut lens = Vec::new();
        for cut in 0..=bytes.len() {
            let mut portion = portion();
            let first = portion.len(&bytes[..cut]);
            portion.skip(first);
            lens.push(first + portion.len(&bytes[first..]));
        }
        assert!(lens.iter().all(|len| *len == lens[0]), "{lens:?}");
        lens[0]
    }

    #[test]
    fn a_header_ends_with_an_empty_line() {
        for header in ["GET / HTTP/1.1\r\nHost: x\r\n\r\n", "GET / HTTP/1.1\nHost: x\n\n"] {
            let bytes = format!("{header}GET /next");
            let head = || Portion::Head(HeadEnd::default());
            assert_eq!(ends(head, bytes.as_bytes()), header.len());
        }
    }

    #[test]
    fn a_body_in_chunks_ends_with_its_trailer() {
        for body in [
            "0\r\n\r\n",
            "3\r\nabc\r\n0\r\n\r\n",
            "0\r\nX: y\n\r\nZ: \n\n\r\n\r\n",
            "3;x=\"1\"\r\n0\r\n\r\n1A\r\nabcdefghijklmnopqrstuvwxyz\r\n000\r\nX: y\r\n\r\n",
        ] {
            let bytes = format!("{body}GET / HTTP/1.1\r\n\r\n");
            let chunks = || Portion::Chunks(ChunksEnd::default());
            assert_eq!(ends(chunks, bytes.as_bytes()), body.len());
        }
    }

    #[test]
    fn what_proxies_could_read_otherwise_is_noticed_wherever_it_is_cut() {
        for (fields, is_ambiguous) in [
            ("Transfer-encoding: chunked\r\nX: y\r\nCONTENT-LENGTH: 5", true),
            ("Transfer-Encoding: gzip, chunked", true),
            ("Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked", true),
            ("Transfer-Encoding:  Chunked\t", false),
            ("Content-Length: 5", false),
        ] {
            let header = format!("POST / HTTP/1.1\r\n{fields}\r\n\r\n").into_bytes();
            for cut in 0..header.len() {
                let mut end = HeadEnd::default();
                end.find(&header[..cut]);
                end.search.skip(cut);
                end.find(&header[cut..]);
                assert_eq!(end.is_ambiguous(), is_ambiguous, "{fields}");
            }
        }
    }
}
