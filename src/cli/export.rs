//! `tcgs export`: a scene as plain Gaussians in a format that viewers read, and what that costs.

use std::path::PathBuf;

use clap::ValueEnum;
use serde::Serialize;
use tcgs::domain::{Camera, Dataset, Digest, Image, Problem, SceneFormat, Split};

use super::{Failure, Report, adapter::AdapterFlag, files, wiring};

/// A format that other programs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// The field's file of floats, before activation
    Ply,
    /// Small integers, version 4 of the format: a tenth of the size
    Spz,
    /// The same integers in version 3, for viewers that do not read version 4
    Spz3,
}

/// Arguments of `tcgs export`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

    /// What to write
    #[arg(long, value_enum)]
    format: Format,

    /// The file to write
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,

    /// The dataset that it was trained on: colours are fitted to what its training cameras see, and the loss is measured on
    /// its held-out views. Without it, cameras on a sphere around the scene serve for both, which suits an object seen from
    /// all sides and nothing else
    #[arg(long)]
    dataset: Option<PathBuf>,

    /// Highest degree of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: u8,

    /// Do not measure the loss; no adapter is needed then
    #[arg(long)]
    unmeasured: bool,

    #[command(flatten)]
    adapter: AdapterFlag,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

#[derive(Debug, Serialize)]
struct Summary {
    output: PathBuf,
    format: SceneFormat,
    bytes: usize,
    gaussians: usize,
    sh_degree: u8,
    source: Source,
    /// Null if the source holds plain Gaussians already.
    baked: Option<wiring::Baking>,
    /// Null for a `.ply`.
    spz: Option<wiring::Packing>,
    /// Null if it was not to be measured.
    quality: Option<wiring::Quality>,
}

#[derive(Debug, Serialize)]
struct Source {
    format: SceneFormat,
    bytes: usize,
    anchors: usize,
    gaussians: usize,
    decode_sha256: Digest,
}

/// Bakes, writes, measures.
pub(crate) fn run(args: &Args) -> Result<Report, Failure> {
    files::check_writable(&args.output)?;
    let in_file = |problem: Problem| problem.in_file(args.file.display().to_string());
    let bytes = files::read(&args.file)?;
    let file = wiring::read(&bytes).map_err(in_file)?;
    let dataset = args.dataset.as_deref().map(wiring::load_dataset).transpose()?;
    if let (Some(path), Some(dataset), Some(stated)) = (&args.dataset, &dataset, file.dataset)
        && stated != dataset.digest
    {
        eprintln!(
            "tcgs: note: {} was trained on another dataset than {}",
            args.file.display(),
            path.display()
        );
    }
    let format = match args.format {
        Format::Ply => SceneFormat::Ply,
        Format::Spz => SceneFormat::Spz,
        Format::Spz3 => SceneFormat::Spz3,
    };
    let cameras = dataset.as_ref().map(training_cameras);
    let exported = wiring::export(&file, format, args.sh_degree, cameras.as_deref()).map_err(in_file)?;
    let source = Source {
        format: file.format,
        bytes: bytes.len(),
        anchors: file.scene.anchors(),
        gaussians: file.scene.gaussians(),
        decode_sha256: file.decode_sha256,
    };
    files::write(&args.output, &exported.bytes)?;
    let gaussians = wiring::read(&exported.bytes)?.scene.gaussians();
    let quality = if args.unmeasured {
        None
    } else {
        let background = file.background;
        let photographs = dataset.as_ref().map(|dataset| held_out(dataset, background.rgb8())).transpose()?;
        let renderer = wiring::Renderer::open(file, &args.adapter.adapter)?;
        Some(wiring::compare(&renderer, &exported.bytes, background, photographs.as_deref())?)
    };
    let summary = Summary {
        output: args.output.clone(),
        format,
        bytes: exported.bytes.len(),
        gaussians,
        sh_degree: exported.degree,
        source,
        baked: exported.baking,
        spz: exported.packing,
        quality,
    };
    Ok(Report::new(text(&summary), &summary))
}

fn training_cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.split(Split::Train).map(|frame| frame.camera).collect()
}

/// Held-out views with their photographs over a colour.
fn held_out(dataset: &Dataset, background: [u8; 3]) -> Result<Vec<(String, Camera, Image)>, Problem> {
    dataset
        .split(Split::Test)
        .map(|frame| Ok((frame.name.clone(), frame.camera, frame.image.load()?.over(background))))
        .collect()
}

fn text(summary: &Summary) -> String {
    let Summary { source, baked, spz, quality, .. } = summary;
    let mut lines = vec![format!(
        "source    .{}, {} bytes; {} anchors, {} Gaussians",
        source.format.extension(),
        source.bytes,
        source.anchors,
        source.gaussians
    )];
    if let Some(baked) = baked {
        lines.push(format!(
            "baked     from {} views ({}) in {:.2} s; {} offsets that none of them shows are left out",
            baked.views, baked.from, baked.seconds, baked.unseen
        ));
    }
    if let Some(spz) = spz {
        lines.push(format!(
            "packed    version {}, positions to 2^-{}; {} values out of range, {} invisible Gaussians left out",
            spz.version, spz.fractional_bits, spz.clamped, spz.left_out
        ));
    }
    if let Some(quality) = quality {
        let from = format!("over {} views ({})", quality.views, quality.from);
        if let (Some(before), Some(after), Some(lost)) =
            (quality.psnr_source, quality.psnr, quality.psnr_lost)
        {
            lines.push(format!(
                "lost      {lost:.2} dB of PSNR: {before:.2} before, {after:.2} after, {from}"
            ));
        }
        lines.push(format!(
            "likeness  PSNR {:.2} dB to the source's own renders, {from}",
            quality.psnr_to_source
        ));
        lines.push(format!("adapter   {}", quality.adapter));
    }
    lines.push(format!(
        "wrote     {}: {} bytes, {} Gaussians, spherical harmonics to degree {}",
        summary.output.display(),
        summary.bytes,
        summary.gaussians,
        summary.sh_degree
    ));
    lines.join("\n")
}
