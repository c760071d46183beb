//! Ends connections whose client reads nothing for too long, or too slowly on average.
//!
//! Only time counts in which there is data to send and the client's window is full, so slow handlers and quiet streams cost the client
//! nothing. Timeouts for reading from the client are set where it is known what is read.

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

/// How fast a client has to read.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ReadRate {
    /// Longest time in which it reads nothing.
    pub(crate) max_stall: Duration,
    /// Bytes per second that it has to read on average, once it has stalled that long.
    pub(super) bytes_per_second: u64,
}

impl ReadRate {
    fn earned_by(self, bytes: usize) -> Duration {
        Duration::from_secs_f64(bytes as f64 / self.bytes_per_second.max(1) as f64)
    }
}

/// A stream whose writes fail with [`io::ErrorKind::TimedOut`] if its peer stalls.
#[derive(Debug)]
pub(crate) struct StallGuard<S> {
    stream: S,
    min_rate: ReadRate,
    /// Remaining time to stall: at most `max_stall`, less the time stalled, plus time earned by bytes read.
    credit: Duration,
    /// Since when the peer stalls, and the timer for when it does too long.
    waiting: Option<(Instant, Pin<Box<Sleep>>)>,
}

impl<S> StallGuard<S> {
    pub(crate) fn new(stream: S, min_rate: ReadRate) -> Self {
        Self { stream, min_rate, credit: min_rate.max_stall, waiting: None }
    }

    /// Charges the time of a pending write; its result, or a timeout.
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
                self.credit = self.min_rate.max_stall.min(self.credit + self.min_rate.earned_by(bytes));
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

impl<S: AsyncRead + Unpin> AsyncRead for StallGuard<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for StallGuard<S> {
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
        time::{sleep, timeout},
    };

    use super::*;

    const LONG: Duration = Duration::from_secs(600);

    #[tokio::test]
    async fn who_takes_nothing_or_hardly_anything_is_given_up() {
        for dribbles in [false, true] {
            let (server, mut client) = duplex(8);
            // Never as long as this without taking a byte, and far from the rate.
            let min_rate = ReadRate { max_stall: Duration::from_millis(200), bytes_per_second: 1 << 20 };
            let mut guarded = StallGuard::new(server, min_rate);
            let reading = tokio::spawn(async move {
                while dribbles && client.read_u8().await.is_ok() {
                    sleep(Duration::from_millis(5)).await;
                }
                // Open, and idle, for as long as the test lasts.
                sleep(LONG).await;
                drop(client);
            });
            let error = guarded.write_all(&vec![0; 1 << 20]).await.expect_err("too slow");
            assert_eq!(error.kind(), io::ErrorKind::TimedOut);
            reading.abort();
        }
    }

    #[tokio::test]
    async fn answers_in_several_pieces_are_given_up_too() {
        let (server, client) = duplex(8);
        let min_rate = ReadRate { max_stall: Duration::from_millis(50), bytes_per_second: 1 << 20 };
        let mut guarded = StallGuard::new(server, min_rate);
        assert!(guarded.is_write_vectored(), "as the stream below");
        let sending = async {
            loop {
                let pieces = [io::IoSlice::new(b"head"), io::IoSlice::new(b"body")];
                assert_ne!(guarded.write_vectored(&pieces).await?, 0, "the stream stays open");
            }
        };
        let error: io::Result<()> = timeout(Duration::from_secs(60), sending).await.expect("given up");
        assert_eq!(error.expect_err("too slow").kind(), io::ErrorKind::TimedOut);
        drop(client);
    }

    #[tokio::test]
    async fn who_takes_what_there_is_is_never_charged_for_what_there_is_not() {
        let (server, mut client) = duplex(8);
        let min_rate = ReadRate { max_stall: LONG, bytes_per_second: 1 };
        let mut guarded = StallGuard::new(server, min_rate);
        let reading = tokio::spawn(async move {
            let mut taken = Vec::new();
            client.read_to_end(&mut taken).await.expect("an end");
            taken.len()
        });
        for _ in 0..3 {
            guarded.write_all(&[0; 1000]).await.expect("in time");
            sleep(Duration::from_millis(20)).await;
        }
        assert!(guarded.credit > LONG / 2, "pauses between answers are the service's own");
        drop(guarded);
        assert_eq!(reading.await.expect("joined"), 3000);
    }

    #[test]
    fn what_is_taken_earns_time_up_to_the_patience() {
        let min_rate = ReadRate { max_stall: Duration::from_secs(30), bytes_per_second: 1000 };
        let mut guarded = StallGuard::new((), min_rate);
        guarded.credit = Duration::from_secs(1);
        let mut context = Context::from_waker(std::task::Waker::noop());
        assert!(matches!(guarded.account(Poll::Ready(Ok(2000)), &mut context), Poll::Ready(Ok(2000))));
        assert_eq!(guarded.credit, Duration::from_secs(3));
        assert!(guarded.account(Poll::Ready(Ok(1 << 20)), &mut context).is_ready());
        assert_eq!(guarded.credit, Duration::from_secs(30));
        let without_rate = ReadRate { bytes_per_second: 0, ..min_rate };
        assert_eq!(without_rate.earned_by(3), Duration::from_secs(3));
    }
}
