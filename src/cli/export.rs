//! `tcgs export`: a scene as plain Gaussians in a format that viewers read, and what that costs.

use std::path::{Path, PathBuf};

use clap::builder::{PossibleValuesParser, TypedValueParser as _};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use tcgs::{
    domain::{
        Background, Camera, Crop, Dataset, Digest, Placement, Problem, Scene, SceneFormat, Split, UpAxis,
    },
    eval::Target,
    export::world::Origin,
};

use super::{CliError, Report, adapter::AdapterFlag, export_page, files, notice::notice, reading, wiring};

/// The formats that other programs read.
const FORMATS: [SceneFormat; 6] = SceneFormat::EXPORTS;

/// The name and extension of a page.
const PAGE: &str = "html";

/// What is written.
#[derive(Debug, Clone, Copy)]
enum Written {
    Scene(SceneFormat),
    /// The scene with its viewer.
    Page,
}

impl Written {
    fn names() -> Vec<&'static str> {
        FORMATS.map(SceneFormat::name).into_iter().chain([PAGE]).collect()
    }

    fn named(name: &str) -> Result<Self, <SceneFormat as std::str::FromStr>::Err> {
        if name == PAGE { Ok(Self::Page) } else { name.parse().map(Self::Scene) }
    }
}

/// Arguments of `tcgs export`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A .tcgs file, the .safetensors or .ply of a baseline, or a .spz
    file: PathBuf,

    /// Format to write: ply, glb or usda for floats, spz for a tenth of the size, spz3 for viewers that read only version 3 of it, sog
    /// for pages, html for a page that shows a .tcgs file itself [default: that of the output's extension]
    #[arg(long, value_parser = PossibleValuesParser::new(Written::names()).try_map(|name| Written::named(&name)))]
    format: Option<Written>,

    /// The file to write
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,

    /// The dataset that it was trained on: colors are fitted to renders from its training cameras, and the loss is measured on
    /// its held-out views. Without it, cameras on a sphere around the scene are used, which suits only objects seen from all
    /// sides
    #[arg(long)]
    dataset: Option<PathBuf>,

    /// Highest degree of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: u8,

    /// Write world coordinates even of a scene so far from the origin that single precision loses detail; the loss is printed.
    /// Otherwise such a file's coordinates are relative to an offset, which is printed and is in a comment of a .ply
    #[arg(long)]
    world: bool,

    /// Turn the scene so that this axis points up: x, y, z, -x, -y or -z. Its upward direction is that of the dataset's training
    /// cameras, so --dataset is needed
    #[arg(
        long,
        value_name = "AXIS",
        allow_hyphen_values = true,
        requires = "dataset",
        value_parser = PossibleValuesParser::new(UpAxis::NAMES).try_map(|name| name.parse::<UpAxis>())
    )]
    up: Option<UpAxis>,

    /// Multiply all lengths by this
    #[arg(long, value_name = "X", default_value_t = 1.0)]
    scale: f64,

    /// Keep at most this many Gaussians: those that the dataset's training cameras, or cameras on a sphere, show most
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    limit_gaussians: Option<usize>,

    /// Steps that refine the Gaussians of a scene of anchors: each compares a render of them with one of the scene, from the dataset's
    /// training cameras and from between them. 0 keeps what the cameras' colors were fitted to at once. Needs --dataset and an adapter
    /// [default: 100; 0 with --unmeasured]
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u32).range(0..=10_000))]
    refine: Option<u32>,

    /// Keep a part of the scene: what at least half of the dataset's training cameras have in view (cameras), or a box
    /// x0,y0,z0,x1,y1,z1 in the dataset's world. The loss is measured against the whole scene
    #[arg(
        long,
        value_name = "cameras|BOX",
        default_value = "none",
        hide_default_value = true,
        allow_hyphen_values = true
    )]
    crop: Crop,

    /// Do not measure the loss, which needs an adapter
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
    /// Null if all Gaussians were kept.
    limited: Option<wiring::Limited>,
    /// Null without a crop.
    cropped: Option<Cropped>,
    /// Null unless the format is a `.spz`.
    spz: Option<wiring::Packing>,
    /// Where the file's coordinates are in the world.
    place: wiring::Place,
    /// How the scene was turned and scaled; null if it was not.
    placement: Option<Placed>,
    /// Null if it was not to be measured.
    quality: Option<wiring::Quality>,
}

#[derive(Debug, Serialize)]
struct Placed {
    up: Option<UpAxis>,
    scale: f64,
    /// The rotation about the world's origin, w, x, y, z.
    rotation: [f64; 4],
}

#[derive(Debug, Serialize)]
struct Cropped {
    region: Crop,
    /// Gaussians removed.
    removed: usize,
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
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let written = match args.format {
        Some(written) => written,
        None => written_for(&args.output)?,
    };
    let Written::Scene(format) = written else { return page(args) };
    let placement = Placement { up: args.up, scale: args.scale };
    let placement = placement.validated().map_err(|error| CliError::Usage(format!("--{error}")))?;
    files::check_output(&args.output, &args.file, &[format.extension()])?;
    args.crop.check().map_err(|error| CliError::Usage(format!("--crop: {error}")))?;
    if args.crop == Crop::Cameras && args.dataset.is_none() {
        return Err(CliError::Usage(
            "--crop: cameras are those of a dataset; name it with --dataset".to_owned(),
        ));
    }
    let in_file = |problem: Problem| problem.in_file(args.file.display().to_string());
    let bytes = files::read(&args.file)?;
    let file = wiring::read(&bytes).map_err(in_file)?;
    let reading = reading::of_scene(&bytes);
    let dataset = args.dataset.as_deref().map(|path| wiring::load_as(path, &reading)).transpose()?;
    if let (Some(path), Some(dataset), Some(stated)) = (&args.dataset, &dataset, file.dataset)
        && stated != dataset.digest
    {
        notice(format_args!(
            "tcgs: note: {} was trained on another dataset than {}",
            args.file.display(),
            path.display()
        ));
    }
    // A file that could not be measured would look like one that failed.
    let renderer = match args.unmeasured {
        true => None,
        false => Some(wiring::SceneViews::open(file.clone(), &args.adapter.adapter).map_err(unmeasurable)?),
    };
    let cameras = dataset.as_ref().map(training_cameras);
    let similarity = placement.similarity(cameras.as_deref().unwrap_or_default());
    let similarity = similarity.map_err(|error| CliError::Usage(format!("--{error}")))?;
    let origin = if args.world { Origin::World } else { Origin::Nearby };
    let settings = wiring::ExportSettings {
        format,
        degree: args.sh_degree,
        origin,
        up: args.up,
        similarity,
        limit: args.limit_gaussians,
        crop: args.crop,
    };
    let (refiner, bar) = refiner(args, &file)?;
    let exported = wiring::export(&file, &settings, cameras.as_deref(), refiner.as_ref());
    bar.finish_and_clear();
    let exported = exported.map_err(in_file)?;
    let source = Source {
        format: file.format,
        bytes: bytes.len(),
        anchors: file.scene.anchors(),
        gaussians: file.scene.gaussians(),
        decode_sha256: file.decode_sha256,
    };
    files::write(&args.output, &exported.bytes)?;
    let gaussians = exported.gaussians;
    let quality = match renderer {
        None => None,
        Some(renderer) => {
            let background = file.background;
            let photographs = dataset.as_ref().map(|dataset| held_out(dataset, background)).transpose()?;
            Some(wiring::compare(&renderer, &exported, background, photographs.as_deref())?)
        }
    };
    let summary = Summary {
        output: args.output.clone(),
        format,
        bytes: exported.bytes.len(),
        gaussians,
        sh_degree: exported.degree,
        source,
        baked: exported.baking,
        limited: exported.limited,
        cropped: exported.cropped.map(|removed| Cropped { region: args.crop, removed }),
        spz: exported.packing,
        place: exported.place,
        placement: (!placement.is_none()).then(|| {
            let turn = similarity.rotation();
            let rotation = [turn.w, turn.x, turn.y, turn.z];
            Placed { up: placement.up, scale: placement.scale, rotation }
        }),
        quality,
    };
    Ok(Report::new(text(&summary), &summary))
}

/// What refines the Gaussians of a file, and the bar of its steps, which is hidden where standard error is no terminal.
fn refiner(
    args: &Args,
    file: &wiring::SceneFile,
) -> Result<(Option<wiring::Refiner>, ProgressBar), CliError> {
    if args.refine.is_some_and(|steps| steps > 0) && args.dataset.is_none() {
        return Err(CliError::Usage("--refine: needs the cameras of a --dataset".to_owned()));
    }
    let steps = args.refine.unwrap_or(if args.unmeasured { 0 } else { wiring::REFINEMENT_STEPS });
    if steps == 0 || args.dataset.is_none() || !matches!(file.scene, Scene::Anchors(_)) {
        return Ok((None, ProgressBar::hidden()));
    }
    let style = ProgressStyle::with_template("{msg} {bar:28} {pos}/{len}  ETA {eta}");
    let bar = ProgressBar::new(u64::from(steps)).with_message("refining");
    let bar = bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    let shown = bar.clone();
    let report = Box::new(move |step: u32| shown.set_position(u64::from(step)));
    Ok((Some(wiring::Refiner::new(args.adapter.adapter.clone(), u64::MAX).with_steps(steps, report)), bar))
}

/// A number of Gaussians.
fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(0) | Err(_) => Err("is not a whole number from 1".to_owned()),
        Ok(count) => Ok(count),
    }
}

/// The format that the name of an output asks for.
fn written_for(output: &Path) -> Result<Written, CliError> {
    let extension = output.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase());
    let format = FORMATS.into_iter().find(|format| extension.as_deref() == Some(format.extension()));
    let page = || (extension.as_deref() == Some(PAGE)).then_some(Written::Page);
    format.map(Written::Scene).or_else(page).ok_or_else(|| {
        let output = output.display();
        CliError::Usage(format!(
            "--output: '{output}' does not end in .ply, .spz, .glb, .usda, .sog or .html; name a --format"
        ))
    })
}

/// Writes the scene with its viewer, which shows the file as it is.
fn page(args: &Args) -> Result<Report, CliError> {
    let changes = [
        ("up", args.up.is_some()),
        ("scale", args.scale != 1.0),
        ("limit-gaussians", args.limit_gaussians.is_some()),
        ("crop", !args.crop.is_none()),
        ("world", args.world),
        ("refine", args.refine.is_some()),
    ];
    if let Some((flag, _)) = changes.into_iter().find(|(_, is_given)| *is_given) {
        return Err(CliError::Usage(format!(
            "--{flag}: a page shows the scene as it is; choose another --format"
        )));
    }
    let reading = reading::of_scene(&files::read(&args.file)?);
    let dataset = args.dataset.as_deref().map(|path| wiring::load_as(path, &reading)).transpose()?;
    export_page::run(&args.file, &args.output, dataset.as_ref())
}

/// The problem of an adapter without which there would be no measurement.
fn unmeasurable(problem: Problem) -> Problem {
    let detail = format!("{}; --unmeasured exports without one", problem.detail);
    Problem { detail, ..problem }
}

fn training_cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.split(Split::Train).map(|frame| frame.camera).collect()
}

/// Held-out views with their photographs over a color.
fn held_out(dataset: &Dataset, background: Background) -> Result<Vec<(String, Camera, Target)>, Problem> {
    dataset
        .split(Split::Test)
        .map(|frame| Ok((frame.name.clone(), frame.camera, Target::of(frame, background)?)))
        .collect()
}

fn text(summary: &Summary) -> String {
    let Summary { source, baked, limited, cropped, spz, place, placement, quality, .. } = summary;
    let mut lines = vec![format!(
        "source    .{}, {} bytes; {} anchors, {} Gaussians",
        source.format.extension(),
        source.bytes,
        source.anchors,
        source.gaussians
    )];
    if let Some(baked) = baked {
        lines.push(format!(
            "baked     from {} views ({}) in {:.2} s; {} offsets invisible in all of them left out",
            baked.views, baked.from, baked.seconds, baked.unseen
        ));
        if let Some(refined) = &baked.refined {
            lines.push(format!(
                "refined   by {} renders of the scene in {:.2} s",
                refined.steps, refined.seconds
            ));
        }
    }
    if let Some(Cropped { region, removed }) = cropped {
        lines.push(format!("cropped   to {region}; {removed} Gaussians removed"));
    }
    if let Some(limited) = limited {
        lines.push(format!(
            "limited   to {} of {} Gaussians, those that {} views show most",
            summary.gaussians, limited.of, limited.views
        ));
    }
    if let Some(spz) = spz {
        lines.push(format!(
            "packed    version {}, positions to 2^-{}; {} values clamped, {} invisible Gaussians left out",
            spz.version, spz.fractional_bits, spz.clamped, spz.left_out
        ));
    }
    if let Some(rounding) = &place.rounding {
        let [x, y, z] = place.offset;
        lines.push(match place.offset == [0.0; 3] {
            true => format!(
                "place     world coordinates, which single precision rounds by {:.3} units per Gaussian on average, {:.2} of its \
                 standard deviations",
                rounding.mean_shift, rounding.mean_shift_in_deviations
            ),
            false => format!(
                "place     relative to {x} {y} {z} in the world, since single precision there would lose detail; --world forces \
                 world coordinates"
            ),
        });
    }
    if let Some(Placed { up, scale, .. }) = placement {
        let up = up.map_or_else(String::new, |up| format!("{up} points up, "));
        lines.push(format!("placed    {up}lengths times {scale}"));
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
            "fidelity  PSNR {:.2} dB to the source's own renders, {from}",
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
