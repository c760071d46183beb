//! What stands behind an error, whichever library wrapped it.

use std::{error::Error, io, iter};

/// The error, then its causes, outermost first. What an [`io::Error`] wraps is among them, though it is not among its sources.
pub fn causes<'a>(error: &'a (dyn Error + 'static)) -> impl Iterator<Item = &'a (dyn Error + 'static)> {
    iter::successors(Some(error), |&error| {
        let wrapped = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        wrapped.map(|wrapped| wrapped as &(dyn Error + 'static)).or_else(|| error.source())
    })
}

/// Whether the operating system said that a disk, or its user's quota on it, is full.
#[must_use]
pub fn is_no_space(error: &(dyn Error + 'static)) -> bool {
    let full = |kind| matches!(kind, io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded);
    causes(error).any(|cause| cause.downcast_ref::<io::Error>().is_some_and(|error| full(error.kind())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_space_is_seen_through_whatever_wraps_it() {
        for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
            let full = || io::Error::from(kind);
            assert!(is_no_space(&full()));
            assert!(is_no_space(&io::Error::other(full())));
            assert!(is_no_space(&io::Error::new(io::ErrorKind::InvalidData, io::Error::other(full()))));
        }
        assert!(!is_no_space(&io::Error::from(io::ErrorKind::PermissionDenied)));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_systems_error_codes_are_recognized() {
        for errno in [rustix::io::Errno::NOSPC, rustix::io::Errno::DQUOT] {
            assert!(is_no_space(&io::Error::from(errno)), "{errno}");
        }
    }
}
