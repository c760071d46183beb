//! `tcgs eval`: what a file is worth on the views that its training never saw.

use std::{collections::HashSet, path::PathBuf, time::Instant};

use serde::Serialize;
use tcgs::domain::{
    Background, ByteCounts, ColorFitScores, Conventions, Digest, Image, Scores, ViewScore,
    dataset::without_extension,
};
use tcgs_lab::lpips::Lpips;

use super::{
    CliError, Report, adapter::AdapterFlag, files, lpips::LpipsFlag, notice::notice, picture,
    reading::ReadFlags, train::MEASURED, wiring,
};

/// Arguments of `tcgs eval`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

    /// The dataset that it was trained on
    dataset: PathBuf,

    /// Also write each held-out photograph and its render, side by side, into this folder
    #[arg(long, value_name = "DIR")]
    save: Option<PathBuf>,

    /// Also print a table of the views
    #[arg(long)]
    per_view: bool,

    #[command(flatten)]
    reading: ReadFlags,

    #[command(flatten)]
    lpips: LpipsFlag,

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
    conventions: Conventions,
    color_fit: Option<ColorFitScores>,
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
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let Args { file, dataset: dataset_path, .. } = args;
    let lpips = wiring::lpips(args.lpips.lpips.as_deref())?;
    let bytes = files::read(file)?;
    let in_file = |problem: tcgs::domain::Problem| problem.in_file(file.display().to_string());
    let (decoded, decode_seconds) = timed(|| wiring::read(&bytes).map_err(in_file))?;
    let byte_counts = decoded.byte_counts.clone();
    let (dataset, ingest_seconds) = timed(|| wiring::load_as(dataset_path, &args.reading.options()))?;

    let same_dataset = decoded.dataset.map(|digest| digest == dataset.digest);
    if same_dataset == Some(false) {
        notice(format_args!(
            "tcgs: note: {} was trained on another dataset than {}",
            file.display(),
            dataset_path.display()
        ));
    }
    let (anchors, gaussians) = (decoded.scene.anchors(), decoded.scene.gaussians());
    let (background, decode_sha256) = (decoded.background, decoded.decode_sha256);
    let renderer = wiring::SceneViews::open(decoded, &args.adapter.adapter)?;
    let mut names = FileNames::default();
    let mut save = |name: &str, render: &Image, photograph: &Image| match &args.save {
        None => Ok(()),
        Some(folder) => picture::write(&folder.join(names.of(name)), &side_by_side(photograph, render)),
    };
    let wiring::Measured { scores: test, color_fit, render_seconds } =
        wiring::score(&renderer, &dataset, background, lpips.as_ref(), &mut save)?;

    let metrics = Metrics {
        test,
        bytes: byte_counts,
        seconds: Seconds { ingest: ingest_seconds, decode: decode_seconds, render: render_seconds },
        anchors,
        gaussians,
        decode_sha256,
        adapter: renderer.adapter.clone(),
        background,
        conventions: Conventions::new(lpips.as_ref().map(Lpips::network)).of(args.reading.options().holdout),
        color_fit,
        same_dataset,
    };
    let mut text = text(&metrics);
    if args.per_view {
        text.push_str(&table(&metrics.test.per_view));
    }
    Ok(Report::new(text, &metrics))
}

/// Names of pictures, each once.
#[derive(Debug, Default)]
struct FileNames(HashSet<String>);

impl FileNames {
    /// The file of a view: its name without folders and the extension of the photograph, and a number where that is taken.
    fn of(&mut self, view: &str) -> String {
        let stem = without_extension(view).replace(['/', '\\'], "_");
        let numbered = (2_usize..).map(|number| format!("{stem}-{number}.png"));
        let mut names = std::iter::once(format!("{stem}.png")).chain(numbered);
        names.find(|name| self.0.insert(name.clone())).unwrap_or(stem)
    }
}

fn timed<T, E>(work: impl FnOnce() -> Result<T, E>) -> Result<(T, f64), E> {
    let start = Instant::now();
    Ok((work()?, start.elapsed().as_secs_f64()))
}

fn text(metrics: &Metrics) -> String {
    let mut scores = match (metrics.test.psnr, metrics.test.ssim) {
        (Some(psnr), Some(ssim)) => format!("PSNR {psnr:.2} dB  SSIM {ssim:.4}"),
        _ => "no held-out views".to_owned(),
    };
    if let (Some(lpips), Some(network)) = (metrics.test.lpips, metrics.test.lpips_network) {
        scores.push_str(&format!("  {network} {lpips:.4}"));
    }
    let halves = metrics.color_fit.map_or_else(String::new, |fit| format!("halves    {fit}\n"));
    format!(
        "test      {scores}  over {} views on {}\n\
         {halves}\
         size      {} bytes; {} anchors, {} Gaussians\n\
         time      {:.2} s decoding, {:.2} s rendering\n\
         adapter   {}\n\
         decoded   {}\n\
         measured  {MEASURED}",
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

/// A line for each view, in the order of the dataset, after an empty one.
fn table(views: &[ViewScore]) -> String {
    let width = views.iter().map(|view| view.name.chars().count()).chain([4]).max().unwrap_or_default();
    let mut table = format!("\n\n{:width$}  PSNR dB    SSIM   LPIPS", "view");
    for ViewScore { name, psnr, ssim, lpips } in views {
        let lpips = lpips.map_or_else(|| "-".to_owned(), |lpips| format!("{lpips:.4}"));
        table.push_str(&format!("\n{name:width$}  {psnr:7.2}  {ssim:.4}  {lpips:>6}"));
    }
    table
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
    fn every_view_has_a_picture_of_its_own() {
        let mut names = FileNames::default();
        let views = ["images/a.png", "images_a.jpg", "clip.0001", "clip.0002", "images\\a"];
        let files = views.map(|view| names.of(view));
        let expected = ["images_a.png", "images_a-2.png", "clip.0001.png", "clip.0002.png", "images_a-3.png"];
        assert_eq!(files, expected);
    }

    #[test]
    fn every_view_has_its_line() {
        let view = |name: &str, psnr, lpips| ViewScore { name: name.to_owned(), psnr, ssim: 0.9, lpips };
        let table = table(&[view("images/a.png", 31.257, Some(0.123_44)), view("b", 100.0, None)]);
        let expected = "\n\n\
            view          PSNR dB    SSIM   LPIPS\n\
            images/a.png    31.26  0.9000  0.1234\n\
            b              100.00  0.9000       -";
        assert_eq!(table, expected);
    }

    #[test]
    fn pairs_are_laid_side_by_side() {
        let left = Image::new(1, 2, 3, vec![1, 1, 1, 2, 2, 2]).expect("an image");
        let right = Image::new(1, 2, 3, vec![8, 8, 8, 9, 9, 9]).expect("an image");
        let pair = side_by_side(&left, &right);
        assert_eq!((pair.width(), pair.height()), (2, 2));
        assert_eq!(pair.samples(), &[1, 1, 1, 8, 8, 8, 2, 2, 2, 9, 9, 9]);
    }
}
