//! Masks of photographs without cameras, as COLMAP reads them, so that people and cars that are ignored do not place cameras.

use std::{fs, io, path::Path};

use image::{ImageFormat, metadata::Orientation};

use super::{
    error::{IngestError, IngestErrorKind},
    images,
    limits::Limits,
    mask_pixels::Plane,
    mask_reader::{FrameMasks, MaskOptions, MaskReader},
    mask_search::find_masks,
    plan::{Plan, PlannedFrame},
    tree::{Purpose, Tree},
    unposed::Unposed,
};
use crate::domain::{Layout, MaskMode, MaskSource, Pose, Split};

/// The most memory for decoding one mask to learn what it hides.
const DECODE_BYTES: u64 = 1 << 30;

impl Unposed {
    /// Writes what masks hide of the photographs into the folder `to`: of the photograph `NAME` the file `NAME.png`, gray, black where it is
    /// ignored. Returns how many photographs have a mask; nothing is written if none has. What is cut out is not ignored, so callers leave such masks out.
    ///
    /// # Errors
    /// As for the masks of a dataset; files that cannot be written; [`IngestErrorKind::Stopped`].
    pub fn write_masks(
        &self,
        path: &Path,
        source: &MaskSource,
        to: &Path,
        should_continue: &(dyn Fn() -> bool + Sync),
    ) -> Result<usize, IngestError> {
        let Self::Photographs { names, .. } = self else { return Ok(0) };
        let limits = Limits::default();
        let tree = Tree::open(Purpose::Load, path, &limits)?;
        let mut plan = Plan::new(Layout::Photographs);
        plan.frames = names.iter().map(|name| frame(name)).collect();
        plan.listed = names.iter().cloned().collect();
        let mut found = find_masks(&tree, &plan, source)?;
        let options = MaskOptions { mode: MaskMode::Ignore, decode_bytes: DECODE_BYTES, should_continue };
        let reader = MaskReader::new(&tree, &found, &limits, &options)?;
        let with_masks = found.count();
        if with_masks == 0 {
            return Ok(0);
        }
        for (name, files) in names.iter().zip(std::mem::take(&mut found.of_frames)) {
            if !should_continue() {
                return Err(IngestErrorKind::Stopped.into());
            }
            let header = images::header(&tree, name, &limits)?;
            let masks = reader.of_frame(files, &header, header.size, Orientation::NoTransforms)?;
            let plane = hidden(&tree, &masks, header.size, &limits)?;
            write(&plane, &to.join(format!("{name}.png"))).map_err(IngestErrorKind::Write)?;
        }
        Ok(with_masks)
    }
}

fn frame(name: &str) -> PlannedFrame {
    PlannedFrame {
        name: name.to_owned(),
        file: name.to_owned(),
        lens: 0,
        pose: Pose::IDENTITY,
        split: Split::Train,
        mask: None,
    }
}

/// What the masks of a photograph of a size hide together: nothing without one, which COLMAP needs to be told too.
fn hidden(
    tree: &Tree,
    masks: &FrameMasks,
    (width, height): (u32, u32),
    limits: &Limits,
) -> Result<Plane, IngestError> {
    let mut all = Plane { width, height, samples: vec![255; width as usize * height as usize] };
    for mask in &masks.files {
        let bytes = tree.read(&mask.file)?;
        let plane = Plane::decode(&bytes, mask.turn, mask.hidden, limits)
            .map_err(|error| error.at(&mask.file))?
            .resized(width, height)
            .hard();
        all = all.least(&plane);
    }
    Ok(all)
}

fn write(plane: &Plane, file: &Path) -> io::Result<()> {
    fs::create_dir_all(file.parent().unwrap_or(file))?;
    let Plane { width, height, samples } = plane;
    let written = image::save_buffer_with_format(
        file,
        samples,
        *width,
        *height,
        image::ColorType::L8,
        ImageFormat::Png,
    );
    written.map_err(io::Error::other)
}

#[cfg(test)]
mod tests {
    use super::{super::mask_pixels::Hidden, *};

    fn picture(file: &Path, width: u32, value: impl Fn(u32) -> u8) {
        fs::create_dir_all(file.parent().expect("a parent")).expect("a folder");
        image::GrayImage::from_fn(width, 2, |x, _| image::Luma([value(x)])).save(file).expect("written");
    }

    #[test]
    fn masks_are_written_as_colmap_reads_them() {
        let folder = tempfile::tempdir().expect("a folder");
        let (given, to) = (folder.path().join("given"), folder.path().join("to"));
        for name in ["a.png", "b.png", "c.png"] {
            picture(&given.join("DCIM").join(name), 4, |_| 100);
        }
        // Of half the size.
        fs::create_dir_all(given.join("masks")).expect("a folder");
        image::GrayImage::from_fn(2, 1, |x, _| image::Luma([if x == 0 { 0 } else { 255 }]))
            .save(given.join("masks/b.png"))
            .expect("written");
        let unposed = Unposed::find(&given).expect("photographs");
        let write = |source: &MaskSource| unposed.write_masks(&given, source, &to, &|| true);
        assert_eq!(write(&MaskSource::None).expect("none"), 0);
        assert!(!to.exists());
        assert_eq!(write(&MaskSource::Auto).expect("written"), 1);
        let mask = fs::read(to.join("DCIM/b.png.png")).expect("a mask");
        let mask = Plane::decode(&mask, Orientation::NoTransforms, Hidden::Black, &Limits::default());
        assert_eq!(mask.expect("a picture").samples, [0, 0, 255, 255, 0, 0, 255, 255]);
        assert!(to.join("DCIM/a.png.png").exists(), "COLMAP takes no photograph without a mask then");
        let stopped = unposed.write_masks(&given, &MaskSource::Auto, &to, &|| false);
        assert!(matches!(stopped.expect_err("stopped").kind, IngestErrorKind::Stopped));
    }

    #[test]
    fn a_folder_of_masks_may_have_any_name_if_it_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let (given, to) = (folder.path().join("given"), folder.path().join("to"));
        for name in ["a.png", "b.png", "c.png", "people/c.png"] {
            picture(&given.join(name), 4, |x| if x == 0 { 0 } else { 255 });
        }
        let source = MaskSource::Folder("people".to_owned());
        let unposed = Unposed::find(&given).expect("photographs").with_masks(&source);
        let Unposed::Photographs { names, masks } = &unposed else { panic!("no photographs") };
        assert_eq!((names.len(), masks.as_slice()), (3, &["people/c.png".to_owned()][..]));
        assert_eq!(unposed.write_masks(&given, &source, &to, &|| true).expect("written"), 1);
        assert!(to.join("c.png.png").exists());
    }
}
