//! `tcgs bench views`: frames a second of a finished scene, as the device renders them and as a client gets them.
//!
//! Times are of this process alone, after a first view that is not counted. While a view is read back, the next renders, and pictures
//! are encoded on all cores meanwhile.

use std::{
    fmt,
    iter::repeat,
    path::PathBuf,
    str::FromStr,
    sync::mpsc,
    time::{Duration, Instant},
};

use serde::Serialize;
use tcgs::{
    domain::{Camera, Image, Intrinsics, Problem, ProblemType},
    gpu::Device,
    picture::PictureFormat,
    render::{RenderError, Renderer},
};

use crate::cli::{CliError, Report, adapter::AdapterFlag, camera::CameraFlags, files, wiring};

/// Views that are in flight before the device is waited for.
const IN_FLIGHT: u32 = 8;

/// The service's quality of JPEG.
const JPEG_QUALITY: u8 = 90;

/// Arguments of `tcgs bench views`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

    #[command(flatten)]
    camera: CameraFlags,

    /// Sizes of the views in pixels; the camera's vertical field of view is kept
    #[arg(
        long,
        value_name = "WxH,...",
        value_delimiter = ',',
        default_values_t = [Size(512, 512), Size(1920, 1080), Size(3840, 2160)]
    )]
    sizes: Vec<Size>,

    /// Seconds of each measurement; three views at least
    #[arg(long, value_name = "S", default_value_t = 2.0, value_parser = positive)]
    seconds: f64,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,

    #[command(flatten)]
    adapter: AdapterFlag,
}

fn positive(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "is not a number".to_owned())?;
    if seconds > 0.0 && seconds <= 3600.0 {
        Ok(seconds)
    } else {
        Err("must be above 0 and at most 3600".to_owned())
    }
}

/// Width and height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Size(u32, u32);

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.0, self.1)
    }
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text
            .split_once('x')
            .and_then(|(width, height)| Some((width.parse::<u32>().ok()?, height.parse::<u32>().ok()?)));
        match sides {
            Some((width, height)) if width > 0 && height > 0 => Ok(Self(width, height)),
            _ => Err("must be like 1920x1080".to_owned()),
        }
    }
}

#[derive(Debug, Serialize)]
struct Views {
    /// Adapter, driver and backend.
    adapter: String,
    sizes: Vec<Measured>,
}

/// Frames a second at one size.
#[derive(Debug, Serialize)]
struct Measured {
    width: u32,
    height: u32,
    /// Rendered, and left on the device.
    device: f64,
    /// Rendered and read back as 8-bit RGB.
    image: f64,
    /// And encoded as JPEG, as the service delivers them: as many at once as there are cores.
    jpeg: f64,
}

/// Measures every size.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let bytes = files::read(&args.file)?;
    let camera = args.camera.camera(&bytes)?;
    let file = wiring::read(&bytes).map_err(|problem| problem.in_file(args.file.display().to_string()))?;
    let device = Device::new(&args.adapter.adapter).map_err(Problem::from)?;
    let mut renderer = Renderer::of_scene(&device, &file.scene, file.background).map_err(Problem::from)?;
    let mut views = Views { adapter: device.adapter_line(), sizes: Vec::new() };
    for size in &args.sizes {
        tracing::info!(%size, "measuring");
        let camera = at_size(&camera, *size)?;
        views.sizes.push(measure(&device, &mut renderer, &camera, Duration::from_secs_f64(args.seconds))?);
    }
    Ok(Report::new(text(&views), &views))
}

/// The same view in a picture of another size: as high, and as wide as that makes it.
fn at_size(camera: &Camera, Size(width, height): Size) -> Result<Camera, Problem> {
    let Intrinsics { fx, fy, cx, cy, width: from_width, height: from_height } = camera.intrinsics;
    let scale = f64::from(height) / f64::from(from_height);
    let middle = |of: f64, from: u32, to: u32| 0.5 * f64::from(to) + scale * (of - 0.5 * f64::from(from));
    let intrinsics = Intrinsics {
        fx: scale * fx,
        fy: scale * fy,
        cx: middle(cx, from_width, width),
        cy: middle(cy, from_height, height),
        width,
        height,
    };
    Camera::new(intrinsics, camera.pose)
        .map_err(|error| Problem::new(ProblemType::ImpossiblePose, error.to_string()))
}

fn measure(
    device: &Device,
    renderer: &mut Renderer,
    camera: &Camera,
    limit: Duration,
) -> Result<Measured, Problem> {
    let first = renderer.render(camera)?;
    let of_device = rate(limit, IN_FLIGHT, || {
        (0..IN_FLIGHT).try_for_each(|_| renderer.submit(camera))?;
        Ok(device.wait()?)
    })?;
    let image = {
        let mut views = renderer.views(repeat(*camera));
        rate(limit, 1, || Ok(views.next().transpose().map(drop)?))?
    };
    let jpeg = encoded_rate(limit, &mut renderer.views(repeat(*camera)))?;
    let (width, height) = (first.width(), first.height());
    Ok(Measured { width, height, device: of_device, image, jpeg })
}

/// Views a second of `views`, which makes `each` at once, over `limit` and at least three calls.
fn rate(limit: Duration, each: u32, mut views: impl FnMut() -> Result<(), Problem>) -> Result<f64, Problem> {
    let started = Instant::now();
    let mut calls = 0;
    while calls < 3 || started.elapsed() < limit {
        views()?;
        calls += 1;
    }
    Ok(f64::from(calls) * f64::from(each) / started.elapsed().as_secs_f64())
}

/// Pictures a second of views that are encoded while the next ones render, over `limit` and at least three pictures.
fn encoded_rate(
    limit: Duration,
    views: &mut dyn Iterator<Item = Result<Image, RenderError>>,
) -> Result<f64, Problem> {
    let at_once = rayon::current_num_threads();
    let started = Instant::now();
    let pictures = rayon::in_place_scope(|scope| -> Result<u32, Problem> {
        let (sender, encoded) = mpsc::channel();
        let (mut submitted, mut finished) = (0, 0);
        while submitted < 3 || started.elapsed() < limit {
            let Some(image) = views.next().transpose()? else { break };
            let sender = sender.clone();
            scope.spawn(move |_| {
                // The receiver is gone only after an error.
                let _ = sender.send(encode(&image));
            });
            submitted += 1;
            if submitted - finished >= at_once as u32 {
                encoded.recv().map_err(|error| not_encoded(&error))??;
                finished += 1;
            }
        }
        drop(sender);
        encoded.iter().collect::<Result<(), Problem>>()?;
        Ok(submitted)
    })?;
    Ok(f64::from(pictures) / started.elapsed().as_secs_f64())
}

fn encode(image: &Image) -> Result<(), Problem> {
    let file = PictureFormat::Jpeg { quality: JPEG_QUALITY }.encode(image);
    file.map(drop).map_err(|error| not_encoded(&error))
}

fn not_encoded(error: &dyn std::error::Error) -> Problem {
    Problem::new(ProblemType::ImageEncoding, error.to_string())
}

fn text(views: &Views) -> String {
    let mut lines = vec![views.adapter.clone(), String::new()];
    lines.push(format!("{:<11}  {:>9}  {:>9}  {:>9}   frames/s", "size", "device", "image", "JPEG"));
    for Measured { width, height, device, image, jpeg } in &views.sizes {
        let size = Size(*width, *height).to_string();
        lines.push(format!("{size:<11}  {device:>9.2}  {image:>9.2}  {jpeg:>9.2}"));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use tcgs::domain::Pose;

    use super::*;

    #[test]
    fn sizes_are_two_numbers_and_an_x() {
        assert_eq!("1920x1080".parse(), Ok(Size(1920, 1080)));
        for wrong in ["1920", "x", "0x5", "5x0", "1920x1080x3", "-1x5", ""] {
            assert!(wrong.parse::<Size>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn another_size_shows_the_same_height_and_keeps_the_principal_point() {
        let intrinsics = Intrinsics { fx: 100.0, fy: 90.0, cx: 60.0, cy: 40.0, width: 100, height: 80 };
        let pose = Pose::look_at(DVec3::ZERO, DVec3::Z, DVec3::Y).expect("a pose");
        let camera = Camera::new(intrinsics, pose).expect("a camera");
        let wide = at_size(&camera, Size(400, 160)).expect("a camera").intrinsics;
        assert_eq!((wide.fx, wide.fy, wide.cx, wide.cy), (200.0, 180.0, 220.0, 80.0));
        assert_eq!((wide.width, wide.height), (400, 160));
    }

    #[test]
    fn an_encoded_rate_counts_at_least_three_pictures_and_ends_at_an_error() {
        let image = || Image::new(8, 8, 3, vec![7; 192]).expect("an image");
        let mut made = 0;
        let rate = encoded_rate(
            Duration::ZERO,
            &mut std::iter::repeat_with(|| {
                made += 1;
                Ok(image())
            }),
        );
        assert!(rate.expect("measures") > 0.0);
        assert_eq!(made, 3);
        let failing = RenderError::Scene("a fault".to_owned());
        let mut views = [Ok(image()), Err(failing)].into_iter();
        assert!(encoded_rate(Duration::ZERO, &mut views).is_err());
    }

    #[test]
    fn a_rate_counts_every_view_of_at_least_three_calls() {
        let mut calls = 0;
        let found = rate(Duration::ZERO, 8, || {
            calls += 1;
            std::thread::sleep(Duration::from_millis(2));
            Ok(())
        })
        .expect("measures");
        assert_eq!(calls, 3);
        assert!(found > 0.0 && found < 24.0 / 0.006, "{found}");
    }
}
