//! Parts of the messages of datasets that are refused.

use thiserror::Error;

/// Longest file name repeated in a message; names in an upload may be up to 64 KiB long.
pub(super) const MAX_NAME_CHARS_SHOWN: usize = 200;

/// Why an image that is listed may be missing.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum MissingHint {
    /// There is a file whose name differs in the case of letters.
    #[error("there is '{0}': upper and lower case must match")]
    Case(String),
    /// There is a file whose name differs in the extension.
    #[error("there is '{0}': extensions must match")]
    Extension(String),
    /// There is a file of that name in a format that is not read.
    #[error("there is '{0}', which is {1}: convert it to PNG or JPEG, `{2}`; tables may keep the old names")]
    Format(String, &'static str, String),
    /// There are several files of that name.
    #[error("there are {0} images called '{1}', and nothing tells which is meant")]
    Places(usize, String),
    /// There is a file of that name outside of the folder that has the tables.
    #[error("there is '{0}', outside of the dataset's folder: move the photographs into it")]
    Outside(String),
    /// The archive's names are not text that can be compared.
    #[error(
        "names in this zip are in a local code page, or at least not marked as UTF-8, so letters beyond ASCII do not match; make \
         the zip with UTF-8 names, for example with 7-Zip (-mcu=on), or send the folder by `tcgs submit`"
    )]
    CodePage,
}

/// A name from an upload made fit for a message: no control characters, bounded length.
pub(super) fn shown(name: &str) -> String {
    let mut text: String = name
        .chars()
        .take(MAX_NAME_CHARS_SHOWN)
        .map(|c| if c.is_control() { '\u{fffd}' } else { c })
        .collect();
    if name.chars().nth(MAX_NAME_CHARS_SHOWN).is_some() {
        text.push('…');
    }
    text
}

/// Advice where photographs have no cameras.
pub(super) fn photographs_alone(photographs: usize, unread: Option<&(&'static str, String)>) -> String {
    match (photographs, unread) {
        (0, None) => String::new(),
        (0, Some((format, remedy))) => {
            format!(". Its {format} images are not read; convert them to PNG or JPEG (`{remedy}`)")
        }
        _ => format!(
            ". The cameras of its {photographs} photographs can be found: tcgs poses FOLDER -o DATASET"
        ),
    }
}

/// The first names, and how many there are besides.
pub(super) fn several(count: usize, first: &[String]) -> String {
    let more = count.saturating_sub(first.len());
    let named = first.join(", ");
    if more == 0 { named } else { format!("{named} and {more} more") }
}

/// How many images are missing, the first of them, and what to do.
pub(super) fn missing_images(
    count: usize,
    listed: usize,
    first: &[String],
    hint: Option<&MissingHint>,
) -> String {
    let mut text =
        format!("{count} of the {listed} images listed here are missing: {}", several(count, first));
    if let Some(hint) = hint {
        text.push_str(&format!(" ({hint})"));
    }
    if count < listed {
        text.push_str(". To go on without them, set skip_missing=true (--skip-missing)");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_images_are_counted_and_the_first_are_named() {
        let first = vec!["a.png".to_owned(), "b.png".to_owned()];
        assert_eq!(
            missing_images(5, 9, &first, Some(&MissingHint::Case("A.png".to_owned()))),
            "5 of the 9 images listed here are missing: a.png, b.png and 3 more (there is 'A.png': upper \
             and lower case must match). To go on without them, set skip_missing=true (--skip-missing)"
        );
    }
}
