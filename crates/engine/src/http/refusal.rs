//! Refusals of requests that reach no handler.

use bytes::Bytes;
use hyper::{HeaderMap, StatusCode};

/// Why a request reaches no handler.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It is not HTTP/1.1 or HTTP/1.0.
    NotHttp,
    /// Its header is too large.
    HeaderTooLarge,
    /// The port takes HTTPS, and it came without TLS.
    NotTls,
}

impl Refusal {
    pub const ALL: [Refusal; 3] = [Refusal::NotHttp, Refusal::HeaderTooLarge, Refusal::NotTls];

    pub const fn name(self) -> &'static str {
        match self {
            Refusal::NotHttp => "not_http",
            Refusal::HeaderTooLarge => "header_too_large",
            Refusal::NotTls => "not_tls",
        }
    }
}

/// The headers and the body of a refusal, as an application words them.
#[derive(Debug, Clone, Default)]
pub struct RefusalBody {
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl RefusalBody {
    /// The headers as lines that end with CR LF, with Content-Length.
    pub(super) fn lines(&self) -> Vec<u8> {
        let mut lines = format!("content-length: {}\r\n", self.body.len()).into_bytes();
        for (name, value) in &self.headers {
            lines.extend([name.as_str().as_bytes(), b": ", value.as_bytes(), b"\r\n"].concat());
        }
        lines
    }
}

const HEADER_END: &[u8] = b"\r\n\r\n";
const NO_BODY: &[u8] = b"content-length: 0\r\n";

/// Completes hyper's response to a request that it can't parse: hyper sends no body.
pub(super) fn completed(response: &[u8], refusal: &RefusalBody) -> Vec<u8> {
    let Some(header) = response.strip_suffix(HEADER_END) else {
        return response.to_vec();
    };
    let header = [header, b"\r\n"].concat();
    let header = match header.windows(NO_BODY.len()).position(|part| part == NO_BODY) {
        Some(at) => [&header[..at], &header[at + NO_BODY.len()..]].concat(),
        None => header,
    };
    [&header, &refusal.lines()[..], b"\r\n", &refusal.body].concat()
}

/// Returns the refusal that the status of hyper's response stands for.
pub(super) fn of_response(response: &[u8]) -> Refusal {
    // After `HTTP/1.1 `.
    let status = response.get(9..12).and_then(|code| StatusCode::from_bytes(code).ok());
    match status {
        Some(StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE | StatusCode::URI_TOO_LONG) => {
            Refusal::HeaderTooLarge
        }
        _ => Refusal::NotHttp,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_has_the_body_of_the_application() {
        let refusal = RefusalBody { headers: HeaderMap::new(), body: Bytes::from_static(b"{}") };
        let hyper = b"HTTP/1.1 431 Request Header Fields Too Large\r\nconnection: close\r\n\
            content-length: 0\r\ndate: Sun\r\n\r\n";
        assert_eq!(of_response(hyper), Refusal::HeaderTooLarge);
        let expected = b"HTTP/1.1 431 Request Header Fields Too Large\r\nconnection: close\r\n\
            date: Sun\r\ncontent-length: 2\r\n\r\n{}";
        assert_eq!(completed(hyper, &refusal), expected);
    }
}
