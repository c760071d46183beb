//! The bundled scene is a dataset like any other: the reader takes it, as a folder and as a zip, and what it reads
//! fits together.

use glam::DVec3;
use tcgs::{
    domain::{Camera, Dataset, Frame, Layout, Split},
    ingest,
    sample::{self, SampleError, Settings},
};

use crate::support::small_disk::SmallDisk;

const SMALL: Settings = Settings { points: 3000, ..Settings::square(128) };

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_keeps_nothing_of_a_scene() {
    let Some(disk) = SmallDisk::mount(1) else { return };
    disk.fill();
    let enough = Settings { points: 50, ..Settings::square(16) };
    for name in ["scene.zip", "scene"] {
        // The second try meets the same disk, and not what the first one left.
        for _ in 0..2 {
            let error = sample::write(&disk.path().join(name), &enough).expect_err("no room");
            assert!(matches!(error, SampleError::Io { .. }), "{error}");
        }
    }
    disk.make_room();
    sample::write(&disk.path().join("scene.zip"), &enough).expect("there is room again");
}

#[test]
fn the_reader_takes_the_bundled_scene_as_folder_and_as_zip() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (directory, zip) = (folder.path().join("scene"), folder.path().join("scene.zip"));
    sample::write(&directory, &SMALL).expect("writes");
    sample::write(&zip, &SMALL).expect("writes");
    let from_directory = ingest::load(&directory).expect("a readable folder");
    let from_zip = ingest::load(&zip).expect("a readable zip");
    assert_eq!(from_directory.digest, from_zip.digest, "one content, one digest");

    for dataset in [&from_directory, &from_zip] {
        assert_eq!(dataset.layout, Layout::Nerfstudio);
        assert_eq!(dataset.split(Split::Train).count(), 40);
        assert_eq!(dataset.split(Split::Test).count(), 8);
        assert_eq!(dataset.find_frame("view_06").expect("a frame").split, Split::Test);
    }
    check_colors(&from_directory);
}

/// The points, projected by the cameras that were read, land on pixels of their colors; turned by five degrees they
/// do not. A mistake in any convention on the way (axes, rows, pixel centers) would show here.
fn check_colors(dataset: &Dataset) {
    let straight = median_difference(dataset, |camera| *camera);
    let turned = median_difference(dataset, |camera| {
        let target = camera.pose.rotation().transpose() * DVec3::Z;
        let side = camera.pose.rotation().transpose() * DVec3::X;
        let up = camera.pose.rotation().transpose() * -DVec3::Y;
        let center = camera.pose.center();
        let pose =
            tcgs::domain::Pose::look_at(center, center + target + side * 5.0_f64.to_radians().tan(), up)
                .expect("a pose");
        Camera { pose, ..*camera }
    });
    assert!(straight < 20, "the median color difference is {straight}");
    assert!(turned > 2 * straight, "turned by five degrees it is {turned}, not much more than {straight}");
}

fn median_difference(dataset: &Dataset, change: impl Fn(&Camera) -> Camera) -> u8 {
    let points = dataset.points.as_ref().expect("a point cloud");
    assert_eq!(points.positions.len(), SMALL.points);
    let mut differences = Vec::new();
    for frame in dataset.frames.iter().filter(|frame| frame.camera.pose.center().z > 2.0) {
        let camera = change(&frame.camera);
        for (position, color) in points.positions.iter().zip(&points.colors) {
            if !is_paving(position) {
                continue;
            }
            if let Some(pixel) = pixel_at(frame, &camera, DVec3::from_array(*position)) {
                differences.extend((0..3).map(|channel| pixel[channel].abs_diff(color[channel])));
            }
        }
    }
    assert!(differences.len() > 1000, "only {} samples", differences.len());
    differences.sort_unstable();
    differences[differences.len() / 2]
}

/// The paved ground: seen from above, little of it is hidden, so no test of visibility is needed here.
fn is_paving(position: &[f64; 3]) -> bool {
    position[2].abs() < 0.01 && position[0].hypot(position[1]) < 1.8
}

fn pixel_at(frame: &Frame, camera: &Camera, point: DVec3) -> Option<[u8; 3]> {
    let (at, _) = camera.project(point)?;
    let image = frame.image.load().expect("in memory");
    let (width, height) = (image.width(), image.height());
    let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < f64::from(width) && at.y < f64::from(height);
    let channels = usize::from(image.channels());
    let first = (at.y as usize * width as usize + at.x as usize) * channels;
    inside.then(|| std::array::from_fn(|channel| image.samples()[first + channel]))
}
