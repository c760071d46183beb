//! `tcgs check`: whether a dataset can be trained on, what it holds, and what a job will take.

use std::path::PathBuf;

use serde::Serialize;
use tcgs::domain::{DatasetSummary, Intrinsics, Layout, NamedCamera};

use super::{
    CliError, Report,
    estimate::{self, Estimate, EstimateFlags, estimate},
    options::TrainFlags,
    wiring,
};

/// Arguments of `tcgs check`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder or zip: Blender, nerfstudio or COLMAP layout
    dataset: PathBuf,

    #[command(flatten)]
    options: TrainFlags,

    #[command(flatten)]
    estimate: EstimateFlags,

    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// What a dataset holds.
#[derive(Debug, Serialize)]
struct Checked {
    #[serde(flatten)]
    summary: DatasetSummary,
    /// Width and height of the images with the fewest and the most pixels, as they are trained on.
    smallest: [u32; 2],
    largest: [u32; 2],
    /// What a job on it will take here.
    estimate: Option<Estimate>,
}

/// Checks tables in full and images by their headers; an unusable dataset is the command's failure.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let options = args.options.validated()?;
    let (summary, cameras) = wiring::survey_dataset(&args.dataset, &options.reading())?;
    let (smallest, largest) = sizes(&cameras);
    let estimate = estimate(&args.dataset, &summary, &cameras, &options, &args.estimate)?;
    let checked = Checked { summary, smallest, largest, estimate: Some(estimate) };
    Ok(Report::new(text(&checked), &checked))
}

fn sizes(cameras: &[NamedCamera]) -> ([u32; 2], [u32; 2]) {
    let sizes = cameras.iter().map(|NamedCamera { camera, .. }| {
        let Intrinsics { width, height, .. } = camera.intrinsics;
        [width, height]
    });
    let pixels = |[width, height]: &[u32; 2]| u64::from(*width) * u64::from(*height);
    (sizes.clone().min_by_key(pixels).unwrap_or_default(), sizes.max_by_key(pixels).unwrap_or_default())
}

fn text(checked: &Checked) -> String {
    let Checked { summary, smallest, largest, estimate } = checked;
    let size = |[width, height]: &[u32; 2]| format!("{width}x{height}");
    let sizes =
        if smallest == largest { size(smallest) } else { format!("{} to {}", size(smallest), size(largest)) };
    let points = match summary.points {
        None | Some(0) => "none: training starts from random points".to_owned(),
        Some(count) => count.to_string(),
    };
    let mut text = match summary.layout {
        Layout::Photographs => {
            format!("layout       photographs\nphotographs  {}, without cameras\n", summary.train)
        }
        Layout::Video => "layout       video\n".to_owned(),
        layout => format!(
            "layout       {layout}\nphotographs  {} to train on, {} held out\nsize         {sizes} pixels, as trained on\n\
             points       {points}\n",
            summary.train, summary.test,
        ),
    };
    for note in &summary.notes {
        text += &format!("note         {note}\n");
    }
    text + &estimate.as_ref().map_or_else(String::new, estimate::text)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use tcgs::domain::{Camera, Pose, Split};

    use super::*;

    fn camera(width: u32, height: u32) -> NamedCamera {
        let intrinsics = Intrinsics { fx: 9.0, fy: 9.0, cx: 4.0, cy: 4.0, width, height };
        let pose = Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z).expect("a view");
        let camera = Camera::new(intrinsics, pose).expect("a camera");
        NamedCamera { name: "a.png".to_owned(), split: Split::Train, camera }
    }

    #[test]
    fn sizes_are_those_with_the_fewest_and_the_most_pixels() {
        let cameras = [camera(800, 600), camera(600, 900), camera(1600, 100)];
        assert_eq!(sizes(&cameras), ([1600, 100], [600, 900]));
    }

    #[test]
    fn the_text_names_a_range_of_sizes_missing_points_and_every_note() {
        let notes = vec!["images undistorted: 3".to_owned(), "every eighth is held out".to_owned()];
        let summary =
            DatasetSummary { layout: Layout::Colmap, train: 7, test: 1, pixels: 9, points: None, notes };
        let checked = Checked { summary, smallest: [800, 600], largest: [1600, 1200], estimate: None };
        assert_eq!(
            text(&checked),
            "layout       colmap\nphotographs  7 to train on, 1 held out\n\
             size         800x600 to 1600x1200 pixels, as trained on\n\
             points       none: training starts from random points\n\
             note         images undistorted: 3\nnote         every eighth is held out\n"
        );
        let notes = vec!["a job finds them first".to_owned()];
        let summary =
            DatasetSummary { layout: Layout::Photographs, train: 7, test: 0, pixels: 9, points: None, notes };
        assert_eq!(
            text(&Checked { summary, smallest: [0, 0], largest: [0, 0], estimate: None }),
            "layout       photographs\nphotographs  7, without cameras\nnote         a job finds them first\n"
        );
    }
}
