//! A connection whose client has to take what it is sent: none of it for too long, or too little on average, ends the connection.
//!
//! Only the time counts in which there is something to send and the client's window is full. So answers that the service is slow to
//! make, and streams that say little, cost their client nothing. Reads have limits elsewhere, where it is known what is read.

use std::{
    future::Future as _,
    io,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    time::{Instant, Sleep, sleep_until},
};

/// How much of its time a client may keep the service waiting.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    /// Longest time in which it takes nothing.
    pub(super) patience: Duration,
    /// Bytes a second that it has to take on average once that much time has been waited.
    pub(super) rate: u64,
}

impl Pace {
    fn earned_by(self, bytes: usize) -> Duration {
        Duration::from_secs_f64(bytes as f64 / self.rate.max(1) as f64)
    }
}

/// A stream that fails with [`io::ErrorKind::TimedOut`] where its other end keeps it waiting.
#[derive(Debug)]
pub(super) struct Paced<S> {
    stream: S,
    pace: Pace,
    /// Time that may still be waited: `patience` at most, less what was waited, and more for what was taken.
    credit: Duration,
    /// Since when the other end takes nothing, and when that is too long.
    waiting: Option<(Instant, Pin<Box<Sleep>>)>,
}

impl<S> Paced<S> {
    pub(super) fn new(stream: S, pace: Pace) -> Self {
        Self { stream, pace, credit: pace.patience, waiting: None }
    }

    /// Charges a wait, and tells what came of the write that it was for.
    fn account(
        &mut self,
        written: Poll<io::Result<usize>>,
        context: &mut Context<'_>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(written) = written {
            if let Some((since, _)) = self.waiting.take() {
                self.credit = self.credit.saturating_sub(since.elapsed());
            }
            if let Ok(bytes) = written {
                self.credit = self.pace.patience.min(self.credit + self.pace.earned_by(bytes));
            }
            return Poll::Ready(written);
        }
        let credit = self.credit;
        let (_, too_long) = self.waiting.get_or_insert_with(|| {
            let now = Instant::now();
            (now, Box::pin(sleep_until(now + credit)))
        });
        match too_long.as_mut().poll(context) {
            Poll::Ready(()) => Poll::Ready(Err(io::Error::new(
                io::ErrorKind::TimedOut,
                "the client takes its answer too slowly",
            ))),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Paced<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Paced<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.account(written, context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(context, bytes);
        self.account(written, context)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::{
        io::{AsyncReadExt as _, AsyncWriteExt as _, duplex},
        time::sleep,
    };

    use super::*;

    const LONG: Duration = Duration::from_secs(600);

    #[tokio::test]
    async fn who_takes_nothing_or_hardly_anything_is_given_up() {
        for dribbles in [false, true] {
            let (server, mut client) = duplex(8);
            // Never as long as this without taking a byte, and far from the rate.
            let pace = Pace { patience: Duration::from_millis(200), rate: 1 << 20 };
            let mut paced = Paced::new(server, pace);
            let reading = tokio::spawn(async move {
                while dribbles && client.read_u8().await.is_ok() {
                    sleep(Duration::from_millis(5)).await;
                }
                // Open, and idle, for as long as the test lasts.
                sleep(LONG).await;
                drop(client);
            });
            let fault = paced.write_all(&vec![0; 1 << 20]).await.expect_err("too slow");
            assert_eq!(fault.kind(), io::ErrorKind::TimedOut);
            reading.abort();
        }
    }

    #[tokio::test]
    async fn who_takes_what_there_is_is_never_charged_for_what_there_is_not() {
        let (server, mut client) = duplex(8);
        let pace = Pace { patience: LONG, rate: 1 };
        let mut paced = Paced::new(server, pace);
        let reading = tokio::spawn(async move {
            let mut taken = Vec::new();
            client.read_to_end(&mut taken).await.expect("an end");
            taken.len()
        });
        for _ in 0..3 {
            paced.write_all(&[0; 1000]).await.expect("in time");
            sleep(Duration::from_millis(20)).await;
        }
        assert!(paced.credit > LONG / 2, "pauses between answers are the service's own");
        drop(paced);
        assert_eq!(reading.await.expect("joined"), 3000);
    }

    #[test]
    fn what_is_taken_earns_time_up_to_the_patience() {
        let pace = Pace { patience: Duration::from_secs(30), rate: 1000 };
        let mut paced = Paced::new((), pace);
        paced.credit = Duration::from_secs(1);
        let mut context = Context::from_waker(std::task::Waker::noop());
        assert!(matches!(paced.account(Poll::Ready(Ok(2000)), &mut context), Poll::Ready(Ok(2000))));
        assert_eq!(paced.credit, Duration::from_secs(3));
        assert!(paced.account(Poll::Ready(Ok(1 << 20)), &mut context).is_ready());
        assert_eq!(paced.credit, Duration::from_secs(30));
    }
}
