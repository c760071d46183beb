//! Videos: MP4 and QuickTime, which are one format (ISO/IEC 14496-12), known by their first box.

use std::{fs::File, io::Read as _, path::Path};

/// Extensions, lower case.
const EXTENSIONS: [&str; 3] = ["mp4", "mov", "m4v"];

/// Bytes at the beginning of a file that tell a video.
pub(super) const SIGNATURE_BYTES: u64 = 8;

/// Types of the first box; older QuickTime files have no `ftyp`.
const FIRST_BOXES: [&[u8; 4]; 6] = [b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"];

/// The name of a video whose file has no name of a video.
const UNNAMED: &str = "video.mp4";

/// Whether a name has the extension of a video.
pub(super) fn is_video_name(name: &str) -> bool {
    name.rsplit_once('.')
        .is_some_and(|(_, extension)| EXTENSIONS.iter().any(|e| extension.eq_ignore_ascii_case(e)))
}

/// Whether a file that begins with these bytes is a video.
pub(super) fn is_video(head: &[u8]) -> bool {
    FIRST_BOXES.iter().any(|first| head.get(4..8) == Some(&first[..]))
}

/// The name of the video in a file; `None` if the file is none, or cannot be read.
pub(super) fn name_of(path: &Path) -> Option<String> {
    let mut head = Vec::new();
    File::open(path).ok()?.take(SIGNATURE_BYTES).read_to_end(&mut head).ok()?;
    let name = path.file_name().and_then(|name| name.to_str()).filter(|name| is_video_name(name));
    is_video(&head).then(|| name.unwrap_or(UNNAMED).to_owned())
}
