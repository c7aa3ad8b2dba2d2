//! The body of a response, as hyper takes it from an exchange.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use hyper::Response;
use hyper::body::{Body, Frame, SizeHint};
use hyper::header::{CONNECTION, HeaderValue};

use super::exchange::{Abandoned, Exchange, ResponseHead};
use super::line::SharedLine;

/// The body of a response. When it is dropped, the response is complete, or the connection is broken.
pub(super) struct ResponseBody {
    exchange: Arc<Exchange>,
    line: SharedLine,
    content: Content,
}

enum Content {
    Whole(Option<Bytes>),
    Stream,
    Ended,
}

impl ResponseBody {
    pub(super) fn whole(
        (exchange, line): (Arc<Exchange>, SharedLine),
        mut head: ResponseHead,
        body: Bytes,
        closes: bool,
    ) -> Response<ResponseBody> {
        if closes {
            head.headers.insert(CONNECTION, HeaderValue::from_static("close"));
        }
        let content = if body.is_empty() { Content::Ended } else { Content::Whole(Some(body)) };
        response(head, ResponseBody { exchange, line, content })
    }

    pub(super) fn stream(
        (exchange, line): (Arc<Exchange>, SharedLine),
        head: ResponseHead,
    ) -> Response<ResponseBody> {
        response(head, ResponseBody { exchange, line, content: Content::Stream })
    }
}

fn response(head: ResponseHead, body: ResponseBody) -> Response<ResponseBody> {
    let mut response = Response::new(body);
    *response.status_mut() = head.status;
    *response.headers_mut() = head.headers;
    response
}

impl Body for ResponseBody {
    type Data = Bytes;
    type Error = Abandoned;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Self::Error>>> {
        let data = match &mut self.content {
            Content::Whole(body) => body.take().map(Ok),
            Content::Stream => match self.exchange.poll_data(context) {
                Poll::Ready(data) => data,
                Poll::Pending => return Poll::Pending,
            },
            Content::Ended => None,
        };
        if data.is_none() || matches!(self.content, Content::Whole(_)) {
            self.content = Content::Ended;
        }
        Poll::Ready(data.map(|data| data.map(Frame::data)))
    }

    fn is_end_stream(&self) -> bool {
        matches!(self.content, Content::Ended)
    }

    fn size_hint(&self) -> SizeHint {
        match &self.content {
            Content::Whole(Some(body)) => SizeHint::with_exact(body.len() as u64),
            Content::Whole(None) | Content::Ended => SizeHint::with_exact(0),
            Content::Stream => SizeHint::default(),
        }
    }
}

impl Drop for ResponseBody {
    fn drop(&mut self) {
        // In a response to HEAD, hyper drops the body without polling it.
        let is_complete = !matches!(self.content, Content::Stream);
        self.exchange.finish(is_complete);
        self.line.lock().note_answered();
    }
}
