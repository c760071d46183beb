//! Writes images in the format given by the file's extension.

use std::path::Path;

use image::ImageFormat;
use tcgs::{
    domain::{Image, Problem, ProblemType},
    picture::PictureFormat,
};

use super::{CliError, files};

const JPEG_QUALITY: u8 = 75;

/// The format that a file name asks for: PNG, JPEG or WebP.
pub(crate) fn format_of(path: &Path) -> Result<ImageFormat, CliError> {
    match ImageFormat::from_path(path) {
        Ok(format @ (ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP)) => Ok(format),
        _ => Err(CliError::Usage(format!(
            "--output: '{}' does not end in .png, .jpg or .webp",
            path.display()
        ))),
    }
}

/// Writes `image` to `path` in the format of its name.
pub(crate) fn write(path: &Path, image: &Image) -> Result<(), CliError> {
    let format = match format_of(path)? {
        ImageFormat::Jpeg => PictureFormat::Jpeg { quality: JPEG_QUALITY },
        ImageFormat::WebP => PictureFormat::Webp,
        _ => PictureFormat::Png,
    };
    let file = format.encode(image).map_err(|error| {
        Problem::new(ProblemType::ImageEncoding, error.to_string()).in_file(path.display().to_string())
    })?;
    files::write(path, &file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_written_in_the_format_of_their_name() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let picture = Image::new(2, 1, 3, vec![255, 0, 0, 0, 0, 255]).expect("an image");
        for (name, magic) in [("a.png", &b"\x89PNG"[..]), ("a.jpg", b"\xff\xd8"), ("a.webp", b"RIFF")] {
            let path = folder.path().join(name);
            write(&path, &picture).expect("writes");
            assert!(std::fs::read(&path).expect("a file").starts_with(magic), "{name}");
        }
        let error = write(&folder.path().join("a.tiff"), &picture).expect_err("no such format");
        assert_eq!(error.exit_status(), 2);
    }
}
