//! Limits and fallible allocations for counts that a file states.

use super::error::{DecodeError, Result};

/// Checks a value that a file asks for against the caller's limit.
pub(crate) fn check_limit(what: &'static str, value: u64, limit: u64) -> Result<()> {
    if value <= limit { Ok(()) } else { Err(DecodeError::Limit { what, value, limit }) }
}

/// An empty vector with capacity for `count`, or an error if the allocator has none.
pub(crate) fn reserve<T>(what: &'static str, count: usize) -> Result<Vec<T>> {
    let mut vector = Vec::new();
    match vector.try_reserve_exact(count) {
        Ok(()) => Ok(vector),
        Err(_) => {
            Err(DecodeError::OutOfMemory { what, bytes: count as u64 * std::mem::size_of::<T>() as u64 })
        }
    }
}

/// `count` zeros, or an error if the allocator cannot give them. The system hands out zeroed pages, so whoever fills them touches
/// them first.
pub(crate) fn zeros<T: Clone + Default>(what: &'static str, count: usize) -> Result<Vec<T>> {
    drop(reserve::<T>(what, count)?);
    Ok(vec![T::default(); count])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_count_beyond_the_address_space_is_an_error_with_its_bytes() {
        let count = usize::MAX / 8;
        let error = reserve::<u64>("cells", count).expect_err("no allocator has as much");
        assert_eq!(error, DecodeError::OutOfMemory { what: "cells", bytes: count as u64 * 8 });
    }
}
