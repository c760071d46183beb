//! Writes a walk around the scene as a video, with ffmpeg.

use std::{
    fs::{self, File},
    io::Write as _,
    path::Path,
    process::{Child, Command, Stdio},
};

use super::{SampleError, Settings, scene::Scene, views};

/// Frames a second.
const RATE: &str = "25";

/// Renders `settings.views` frames and has `ffmpeg` write them to `path`, a new file in MP4.
///
/// # Errors
/// [`SampleError`]: something is there already, the size is impossible or odd, ffmpeg is missing, or it fails.
pub fn write_video(
    path: &Path,
    settings: &Settings,
    ffmpeg: &Path,
    watch: &mut dyn FnMut(usize, usize),
) -> Result<usize, SampleError> {
    settings.check()?;
    if settings.width % 2 + settings.height % 2 > 0 {
        return Err(SampleError::OddSize(settings.width, settings.height));
    }
    if path.exists() {
        return Err(SampleError::Exists(path.to_owned()));
    }
    let io = |source| SampleError::Io { path: path.to_owned(), source };
    let work = tempfile::tempdir_in(
        path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new(".")),
    );
    let work = work.map_err(io)?;
    let (part, messages) = (work.path().join("walk.mp4"), work.path().join("messages.txt"));
    let mut child = start(ffmpeg, settings, &part, File::create(&messages).map_err(io)?)?;
    let drawn = draw(&mut child, settings, watch);
    let status = child.wait().map_err(io)?;
    if drawn.is_err() || !status.success() {
        let said = fs::read_to_string(&messages).unwrap_or_default();
        return Err(SampleError::Ffmpeg(said.trim().to_owned()));
    }
    fs::rename(&part, path).map_err(io)?;
    Ok(settings.views)
}

fn draw(child: &mut Child, settings: &Settings, watch: &mut dyn FnMut(usize, usize)) -> std::io::Result<()> {
    // Closed at the end of this function, by which ffmpeg knows that there are no more frames.
    let mut frames = child.stdin.take().expect("a pipe was asked for");
    let scene = Scene::still_life();
    for (index, camera) in views::walk(settings).iter().enumerate() {
        frames.write_all(scene.render(camera).samples())?;
        watch(index + 1, settings.views);
    }
    Ok(())
}

fn start(ffmpeg: &Path, settings: &Settings, to: &Path, messages: File) -> Result<Child, SampleError> {
    let size = format!("{}x{}", settings.width, settings.height);
    let child = Command::new(ffmpeg)
        .args(["-hide_banner", "-loglevel", "error", "-f", "rawvideo", "-pixel_format", "rgb24"])
        .args(["-video_size", &size, "-framerate", RATE, "-i", "pipe:0"])
        .args(["-pix_fmt", "yuv420p", "-movflags", "+faststart"])
        .arg(to)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(messages)
        .spawn();
    child.map_err(|source| SampleError::NoFfmpeg { program: ffmpeg.to_owned(), source })
}
