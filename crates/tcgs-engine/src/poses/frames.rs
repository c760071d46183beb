//! Photographs of a video, taken by ffmpeg: one of each of a number of even steps, the sharpest in it.
//!
//! The video is read twice: once small and gray, to measure sharpness, and once for the frames. ffmpeg gets the format and the protocols
//! `file` and `pipe` alone, within limits of memory and time.

use std::{
    env,
    ffi::OsString,
    fs::{self, File},
    io::{BufReader, Read as _},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc::{self, RecvTimeoutError},
    thread,
    time::{Duration, Instant},
};

use super::{
    PoseLimits, PoseProgress, PoseStage, PosesError, child::last_words, room::full_disk_or, running::Running,
};
use crate::domain::CancelFlag;

/// Size at which sharpness is measured: enough to see the blur of a moving camera.
const WIDTH: usize = 960;
const HEIGHT: usize = 540;

/// Most frames of a video that are read: five hours of 60 a second.
const MAX_FRAMES: usize = 1_080_000;

/// How often the caller's wish to stop is looked at.
const POLL: Duration = Duration::from_millis(100);

/// Time between two reports of progress.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// The program that reads videos: the one that `TCGS_FFMPEG` names, else `ffmpeg`.
#[must_use]
pub fn find_ffmpeg() -> PathBuf {
    let named = env::var_os("TCGS_FFMPEG").filter(|path| !path.is_empty());
    named.map_or_else(|| PathBuf::from("ffmpeg"), PathBuf::from)
}

/// A video whose frames are taken.
pub(super) struct Video<'a> {
    pub(super) ffmpeg: &'a Path,
    pub(super) path: &'a Path,
    pub(super) limits: PoseLimits,
    pub(super) threads: usize,
}

/// Those who wait for the frames.
pub(super) struct Caller<'a> {
    pub(super) report: &'a mut dyn FnMut(PoseProgress),
    pub(super) cancel: &'a CancelFlag,
}

impl Video<'_> {
    /// Writes `count` frames as JPEG files into the folder `to`, or all if there are fewer. Returns their names in order.
    ///
    /// # Errors
    /// [`PosesError::VideoUnavailable`], [`PosesError::VideoUnreadable`], [`PosesError::FramesDied`], [`PosesError::TimedOut`],
    /// [`PosesError::Cancelled`], [`PosesError::Io`] of a full disk.
    pub(super) fn frames(
        &self,
        to: &Path,
        count: usize,
        caller: &mut Caller<'_>,
    ) -> Result<Vec<String>, PosesError> {
        let end = Instant::now() + self.limits.time;
        let io = |what| move |error| PosesError::Io { what, error };
        fs::create_dir_all(to).map_err(io("cannot create a folder for frames"))?;
        let sharpness = self.sharpness(to, count, caller, end)?;
        let chosen = sharpest(&sharpness, count);
        if chosen.is_empty() {
            return Err(PosesError::VideoUnreadable("it has no frames".to_owned()));
        }
        let terms: Vec<String> = chosen.iter().map(|frame| format!("eq(n\\,{frame})")).collect();
        let arguments =
            ["-vf", &format!("select={}", terms.join("+")), "-fps_mode", "passthrough", "-q:v", "2"];
        let output = to.join("frame_%05d.jpg");
        let messages = to.join("messages.txt");
        let child = self.child(&arguments, output.as_os_str(), Stdio::null(), &messages)?;
        let mut running = Running(child);
        let name = |number: usize| format!("frame_{number:05}.jpg");
        let (mut done, mut reported) = (0, Instant::now());
        let status = loop {
            if let Some(status) = running.0.try_wait().map_err(io("cannot wait for ffmpeg"))? {
                break status;
            }
            self.check(caller, end)?;
            thread::sleep(POLL);
            while to.join(name(done + 1)).exists() {
                done += 1;
            }
            if reported.elapsed() > REPORT_INTERVAL {
                reported = Instant::now();
                (caller.report)(progress(done, chosen.len()));
            }
        };
        let names: Vec<String> = (1..=chosen.len()).map(name).collect();
        if !status.success() || !names.iter().all(|name| to.join(name).exists()) {
            return Err(full_disk_or(failure(status, &messages), to));
        }
        fs::remove_file(&messages).map_err(io("cannot remove ffmpeg's messages"))?;
        (caller.report)(progress(names.len(), names.len()));
        Ok(names)
    }

    /// The sharpness of every frame.
    fn sharpness(
        &self,
        to: &Path,
        count: usize,
        caller: &mut Caller<'_>,
        end: Instant,
    ) -> Result<Vec<f64>, PosesError> {
        (caller.report)(progress(0, count));
        let messages = to.join("messages.txt");
        let filter = format!("scale={WIDTH}:{HEIGHT}:flags=area,format=gray");
        let arguments = ["-vf", &filter, "-fps_mode", "passthrough", "-f", "rawvideo"];
        let mut running = Running(self.child(&arguments, "pipe:1".as_ref(), Stdio::piped(), &messages)?);
        let output = running.0.stdout.take();
        let (sender, frames) = mpsc::sync_channel(16);
        thread::spawn(move || {
            let mut output = BufReader::new(output?);
            let mut frame = vec![0; WIDTH * HEIGHT];
            while output.read_exact(&mut frame).is_ok() && sender.send(contrast(&frame)).is_ok() {}
            Some(())
        });
        let (mut sharpness, mut reported) = (Vec::new(), Instant::now());
        loop {
            self.check(caller, end)?;
            if reported.elapsed() > REPORT_INTERVAL {
                reported = Instant::now();
                (caller.report)(progress(0, count));
            }
            match frames.recv_timeout(POLL) {
                Ok(_) if sharpness.len() == MAX_FRAMES => {
                    let detail = format!("it has more than {MAX_FRAMES} frames");
                    return Err(PosesError::VideoUnreadable(detail));
                }
                Ok(frame) => sharpness.push(frame),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        let status =
            running.0.wait().map_err(|error| PosesError::Io { what: "cannot wait for ffmpeg", error })?;
        // A video that was cut off has frames until then.
        if is_killed(status) || (!status.success() && sharpness.is_empty()) {
            return Err(full_disk_or(failure(status, &messages), to));
        }
        Ok(sharpness)
    }

    fn check(&self, caller: &Caller<'_>, end: Instant) -> Result<(), PosesError> {
        if caller.cancel.is_cancelled() {
            return Err(PosesError::Cancelled);
        }
        if Instant::now() >= end {
            return Err(PosesError::TimedOut(self.limits.time));
        }
        Ok(())
    }

    /// ffmpeg within the limit of memory, on the first video stream.
    fn child(
        &self,
        arguments: &[&str],
        output: &std::ffi::OsStr,
        stdout: Stdio,
        messages: &Path,
    ) -> Result<Child, PosesError> {
        let io = |what| move |error| PosesError::Io { what, error };
        let messages = File::create(messages).map_err(io("cannot write ffmpeg's messages"))?;
        let path = fs::canonicalize(self.path).map_err(io("cannot find the video"))?;
        let input = OsString::from_iter(["file:".into(), path.into_os_string()]);
        let kilobytes = match self.limits.memory_bytes {
            0 => "unlimited".to_owned(),
            bytes => (bytes >> 10).max(1).to_string(),
        };
        // The shell sets the limit, which the standard library cannot.
        let child = Command::new("/bin/sh")
            .args(["-c", "ulimit -v \"$0\"; exec \"$@\"", &kilobytes])
            .arg(self.ffmpeg)
            .args([
                "-nostdin",
                "-hide_banner",
                "-loglevel",
                "error",
                "-y",
                "-threads",
                &self.threads.to_string(),
            ])
            .args(["-protocol_whitelist", "file,pipe", "-f", "mov"])
            .arg("-i")
            .arg(input)
            .args(["-map", "0:v:0"])
            .args(arguments)
            .arg(output)
            .stdin(Stdio::null())
            .stdout(stdout)
            .stderr(messages)
            .spawn();
        child.map_err(io("cannot start ffmpeg"))
    }
}

/// Whether a signal has ended a process, as for want of memory: its exit status is a number otherwise.
fn is_killed(status: ExitStatus) -> bool {
    status.code().is_none()
}

/// Why ffmpeg has failed: the video, unless ffmpeg did not end by itself.
fn failure(status: ExitStatus, messages: &Path) -> PosesError {
    let detail = last_words(messages);
    match is_killed(status) {
        true => PosesError::FramesDied { status: status.to_string(), detail },
        false => PosesError::VideoUnreadable(detail),
    }
}

/// The version of ffmpeg.
///
/// # Errors
/// [`PosesError::VideoUnavailable`].
pub fn ffmpeg_version(ffmpeg: &Path) -> Result<String, PosesError> {
    let unavailable = |detail: String| PosesError::VideoUnavailable { ffmpeg: ffmpeg.to_owned(), detail };
    let asked = Command::new(ffmpeg).arg("-version").stdin(Stdio::null()).stderr(Stdio::null()).output();
    let output = asked.map_err(|error| unavailable(error.to_string()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let version = text.strip_prefix("ffmpeg version ").and_then(|rest| rest.split_whitespace().next());
    version.map(str::to_owned).ok_or_else(|| unavailable("it does not tell its version".to_owned()))
}

fn progress(done: usize, total: usize) -> PoseProgress {
    PoseProgress {
        stage: PoseStage::Frames,
        done: done as u64,
        total: total as u64,
        reprojection_error: None,
    }
}

/// The mean squared Laplacian of a gray frame: the less a frame is blurred, the larger it is.
fn contrast(frame: &[u8]) -> f64 {
    let at = |x: usize, y: usize| i64::from(frame[y * WIDTH + x]);
    let mut sum = 0;
    for y in 1..HEIGHT - 1 {
        for x in 1..WIDTH - 1 {
            let laplacian = 4 * at(x, y) - at(x - 1, y) - at(x + 1, y) - at(x, y - 1) - at(x, y + 1);
            sum += laplacian * laplacian;
        }
    }
    sum as f64 / ((WIDTH - 2) * (HEIGHT - 2)) as f64
}

/// The index of the sharpest frame in each of `count` even steps, in order; the first of those that are equally sharp.
fn sharpest(sharpness: &[f64], count: usize) -> Vec<usize> {
    let count = count.min(sharpness.len());
    let best = |step: usize| {
        let (from, to) = (step * sharpness.len() / count, (step + 1) * sharpness.len() / count);
        (from..to).rev().max_by(|a, b| sharpness[*a].total_cmp(&sharpness[*b]))
    };
    (0..count).filter_map(best).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_step_gives_its_sharpest_frame() {
        let sharpness = [1.0, 3.0, 2.0, 5.0, 5.0, 4.0, 0.0, 9.0];
        assert_eq!(sharpest(&sharpness, 4), [1, 3, 4, 7]);
        assert_eq!(sharpest(&sharpness, 3), [1, 3, 7]);
        assert_eq!(sharpest(&sharpness, 99), (0..8).collect::<Vec<_>>());
        assert!(sharpest(&[], 4).is_empty());
    }

    #[test]
    fn a_sharp_frame_has_more_contrast_than_the_same_blurred() {
        let sharp: Vec<u8> =
            (0..WIDTH * HEIGHT).map(|i| if ((i % WIDTH) / 8).is_multiple_of(2) { 40 } else { 200 }).collect();
        let mut blurred = sharp.clone();
        for row in 0..HEIGHT {
            for x in 2..WIDTH - 2 {
                let at = row * WIDTH + x;
                let sum: u32 = sharp[at - 2..=at + 2].iter().map(|sample| u32::from(*sample)).sum();
                blurred[at] = (sum / 5) as u8;
            }
        }
        assert!(contrast(&sharp) > 2.0 * contrast(&blurred));
        assert!(contrast(&vec![7; WIDTH * HEIGHT]) == 0.0);
    }
}
