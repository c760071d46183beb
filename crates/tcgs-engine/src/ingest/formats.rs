//! Image formats that are not read: known by their first bytes or their names, so that a refusal says what to do.

/// A format that is not read.
#[derive(Debug)]
pub(super) struct UnreadFormat {
    /// As people call it.
    pub(super) name: &'static str,
    /// Endings of its files.
    extensions: &'static [&'static str],
    /// The format to convert to: one without loss, unless this one has loss.
    to: &'static str,
    is: fn(&[u8]) -> bool,
}

static FORMATS: [UnreadFormat; 7] = [
    UnreadFormat {
        name: "TIFF",
        extensions: &["tif", "tiff"],
        to: "png",
        is: |head| [&b"II*\0"[..], b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| head.starts_with(magic)),
    },
    UnreadFormat {
        name: "AVIF",
        extensions: &["avif"],
        to: "jpg",
        is: |head| has_brand(head, &[b"avif", b"avis"]),
    },
    UnreadFormat {
        name: "HEIC",
        extensions: &["heic", "heif", "hif"],
        to: "jpg",
        is: |head| has_brand(head, &[b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"]),
    },
    UnreadFormat {
        name: "JPEG XL",
        extensions: &["jxl"],
        to: "jpg",
        is: |head| head.starts_with(b"\xff\x0a") || head.starts_with(b"\0\0\0\x0cJXL "),
    },
    UnreadFormat { name: "BMP", extensions: &["bmp"], to: "png", is: |head| head.starts_with(b"BM") },
    UnreadFormat { name: "GIF", extensions: &["gif"], to: "png", is: |head| head.starts_with(b"GIF8") },
    UnreadFormat {
        name: "OpenEXR",
        extensions: &["exr"],
        to: "png",
        is: |head| head.starts_with(b"\x76\x2f\x31\x01"),
    },
];

/// The format of a file that begins with these bytes.
pub(super) fn by_content(head: &[u8]) -> Option<&'static UnreadFormat> {
    FORMATS.iter().find(|format| (format.is)(head))
}

/// The format of a file of this name.
pub(super) fn by_name(name: &str) -> Option<&'static UnreadFormat> {
    let extension = extension(name)?;
    FORMATS.iter().find(|format| format.extensions.iter().any(|known| extension.eq_ignore_ascii_case(known)))
}

fn extension(name: &str) -> Option<&str> {
    name.rsplit('/').next()?.rsplit_once('.').map(|(_, extension)| extension)
}

impl UnreadFormat {
    /// Whether cameras, phones and developers of raw files write it, so that a folder of photographs may be of it.
    pub(super) fn is_of_cameras(&self) -> bool {
        matches!(self.name, "TIFF" | "AVIF" | "HEIC")
    }

    /// The command that converts such files, named like `file`: of ImageMagick 6, and of 7, which has it too.
    pub(super) fn remedy(&self, file: &str) -> String {
        let extension =
            extension(file).filter(|extension| extension.bytes().all(|byte| byte.is_ascii_alphanumeric()));
        format!("mogrify -format {} *.{}", self.to, extension.unwrap_or(self.extensions[0]))
    }
}

/// Whether a file of the ISO media kind has one of these brands, the major one first.
fn has_brand(head: &[u8], brands: &[&[u8; 4]]) -> bool {
    let Some(start) = head.first_chunk::<12>() else { return false };
    start[4..8] == *b"ftyp" && brands.iter().any(|brand| start[8..] == **brand)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_known_by_content_and_by_name() {
        for (head, name) in [
            (&b"II*\0\x08\0\0\0"[..], "TIFF"),
            (b"MM\0*", "TIFF"),
            (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
            (b"\0\0\0\x24ftypheic\0\0\0\0", "HEIC"),
            (b"\0\0\0\x24ftypmif1\0\0\0\0", "HEIC"),
            (b"BM\x36\0", "BMP"),
            (b"GIF89a", "GIF"),
            (b"\xff\x0a\xfa", "JPEG XL"),
        ] {
            assert_eq!(by_content(head).expect(name).name, name);
        }
        for head in [&b""[..], b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\0WEBP", b"\0\0\0\x1cftyp"]
        {
            assert!(by_content(head).is_none());
        }
        for (file, name) in [("a/IMG_1.HEIC", "HEIC"), ("x.tif", "TIFF"), ("x.y.avif", "AVIF")] {
            assert_eq!(by_name(file).expect(file).name, name);
        }
        assert!(by_name("a.tif/x").is_none() && by_name("a.jpg").is_none() && by_name("tif").is_none());
    }

    #[test]
    fn remedies_are_commands_for_the_files_as_they_are_called() {
        let heic = by_name("a.heic").expect("a format");
        assert_eq!(heic.remedy("images/IMG_1.HEIC"), "mogrify -format jpg *.HEIC");
        assert_eq!(heic.remedy("images/IMG_1.jpg"), "mogrify -format jpg *.jpg");
        assert_eq!(heic.remedy("images/a.$(b)"), "mogrify -format jpg *.heic");
        assert_eq!(by_name("a.tiff").expect("a format").remedy("a.tiff"), "mogrify -format png *.tiff");
    }
}
