//! `tcgs eval`: what a file is worth on the views that its training never saw.

use std::{path::PathBuf, time::Instant};

use serde::Serialize;
use tcgs::domain::{Background, ByteCounts, Digest, Image, Scores, Split};

use super::{Failure, Report, adapter::AdapterFlag, files, picture, wiring};

/// Arguments of `tcgs eval`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, or the .safetensors or .ply of a baseline
    file: PathBuf,

    /// The dataset that it was trained on
    dataset: PathBuf,

    /// Also write each held-out photograph and its render, side by side, into this folder
    #[arg(long, value_name = "DIR")]
    save: Option<PathBuf>,

    #[command(flatten)]
    adapter: AdapterFlag,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// The part of a job's metrics that the file and the dataset alone determine, under the same names.
#[derive(Debug, Serialize)]
struct Metrics {
    test: Scores,
    bytes: ByteCounts,
    seconds: Seconds,
    anchors: usize,
    gaussians: usize,
    decode_sha256: Digest,
    adapter: String,
    background: Background,
    /// Whether the file was trained on this dataset, if it states its dataset.
    same_dataset: Option<bool>,
}

#[derive(Debug, Serialize)]
struct Seconds {
    ingest: f64,
    decode: f64,
    render: f64,
}

/// Decodes, renders every held-out view, measures.
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    let bytes = files::read(&args.file)?;
    let in_file = |problem: tcgs::domain::Problem| problem.in_file(args.file.display().to_string());
    let (decoded, decode_seconds) = timed(|| wiring::read(&bytes).map_err(in_file))?;
    let byte_counts = decoded.byte_counts.clone();
    let (dataset, ingest_seconds) = timed(|| wiring::load_dataset(&args.dataset))?;

    let same_dataset = decoded.dataset.map(|digest| digest == dataset.digest);
    if same_dataset == Some(false) {
        eprintln!(
            "tcgs: note: {} was trained on another dataset than {}",
            args.file.display(),
            args.dataset.display()
        );
    }
    let (anchors, gaussians) = (decoded.scene.anchors(), decoded.scene.gaussians());
    let (background, decode_sha256) = (decoded.background, decoded.decode_sha256);
    let renderer = wiring::Renderer::open(decoded, &args.adapter.adapter)?;
    let (pairs, render_seconds) = timed(|| {
        let mut pairs = Vec::new();
        for frame in dataset.split(Split::Test) {
            let photograph = frame.image.over(background.rgb8());
            pairs.push((renderer.view(&frame.camera)?, photograph));
        }
        Ok::<_, tcgs::domain::Problem>(pairs)
    })?;
    if let Some(folder) = &args.save {
        for (frame, (render, photograph)) in dataset.split(Split::Test).zip(&pairs) {
            let name = frame.name.replace(['/', '\\'], "_");
            let stem = name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem);
            picture::write(&folder.join(format!("{stem}.png")), &side_by_side(photograph, render))?;
        }
    }

    let metrics = Metrics {
        test: wiring::scores(&pairs)?,
        bytes: byte_counts,
        seconds: Seconds { ingest: ingest_seconds, decode: decode_seconds, render: render_seconds },
        anchors,
        gaussians,
        decode_sha256,
        adapter: renderer.adapter.clone(),
        background,
        same_dataset,
    };
    Ok(Report::new(text(&metrics), &metrics))
}

fn timed<T, E>(work: impl FnOnce() -> Result<T, E>) -> Result<(T, f64), E> {
    let start = Instant::now();
    Ok((work()?, start.elapsed().as_secs_f64()))
}

fn text(metrics: &Metrics) -> String {
    let scores = match (metrics.test.psnr, metrics.test.ssim) {
        (Some(psnr), Some(ssim)) => format!("PSNR {psnr:.2} dB  SSIM {ssim:.4}"),
        _ => "no held-out views".to_owned(),
    };
    format!(
        "test      {scores}  over {} views on {}\n\
         size      {} bytes; {} anchors, {} Gaussians\n\
         time      {:.2} s decoding, {:.2} s rendering\n\
         adapter   {}\n\
         decoded   {}",
        metrics.test.views,
        metrics.background,
        metrics.bytes.total,
        metrics.anchors,
        metrics.gaussians,
        metrics.seconds.decode,
        metrics.seconds.render,
        metrics.adapter,
        metrics.decode_sha256,
    )
}

/// Two RGB images of one size, the first on the left.
fn side_by_side(left: &Image, right: &Image) -> Image {
    let row = left.width() as usize * 3;
    let samples = left
        .samples()
        .chunks_exact(row)
        .zip(right.samples().chunks_exact(row))
        .flat_map(|(left, right)| left.iter().chain(right))
        .copied()
        .collect();
    Image::new(left.width() * 2, left.height(), 3, samples).expect("two images of one size fit side by side")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_laid_side_by_side() {
        let left = Image::new(1, 2, 3, vec![1, 1, 1, 2, 2, 2]).expect("an image");
        let right = Image::new(1, 2, 3, vec![8, 8, 8, 9, 9, 9]).expect("an image");
        let pair = side_by_side(&left, &right);
        assert_eq!((pair.width(), pair.height()), (2, 2));
        assert_eq!(pair.samples(), &[1, 1, 1, 8, 8, 8, 2, 2, 2, 9, 9, 9]);
    }
}
