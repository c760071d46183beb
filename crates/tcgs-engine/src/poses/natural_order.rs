//! The order of names in which people count: `img2` before `img10`.

use std::cmp::Ordering;

/// Compares two names: runs of digits by their number, everything else by characters.
#[must_use]
pub fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a_rest, mut b_rest) = (a, b);
    loop {
        let (Some(x), Some(y)) = (a_rest.chars().next(), b_rest.chars().next()) else {
            // Numbers with more zeros in front, after all else is equal.
            return a_rest.len().cmp(&b_rest.len()).then_with(|| a.cmp(b));
        };
        if x.is_ascii_digit() && y.is_ascii_digit() {
            let (x, y) = (digits(a_rest), digits(b_rest));
            let (x_number, y_number) = (x.trim_start_matches('0'), y.trim_start_matches('0'));
            let order = x_number.len().cmp(&y_number.len()).then_with(|| x_number.cmp(y_number));
            if order.is_ne() {
                return order;
            }
            (a_rest, b_rest) = (&a_rest[x.len()..], &b_rest[y.len()..]);
        } else if x == y {
            (a_rest, b_rest) = (&a_rest[x.len_utf8()..], &b_rest[y.len_utf8()..]);
        } else {
            return x.cmp(&y);
        }
    }
}

fn digits(text: &str) -> &str {
    &text[..text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len())]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn numbers_in_names_are_counted() {
        let mut names =
            ["img10.jpg", "img2.jpg", "a/img1.jpg", "img02.jpg", "img.jpg", "ímg1.jpg", "img2b.jpg"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            ["a/img1.jpg", "img.jpg", "img02.jpg", "img2.jpg", "img2b.jpg", "img10.jpg", "ímg1.jpg"]
        );
    }

    proptest! {
        #[test]
        fn it_is_an_order(names in prop::collection::vec("[a0-2é]{0,5}", 3)) {
            let [a, b, c] = [&names[0], &names[1], &names[2]];
            prop_assert_eq!(natural_order(a, b), natural_order(b, a).reverse());
            prop_assert_eq!(natural_order(a, b).is_eq(), a == b);
            if natural_order(a, b).is_le() && natural_order(b, c).is_le() {
                prop_assert!(natural_order(a, c).is_le());
            }
        }
    }
}
