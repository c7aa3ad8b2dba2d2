//! Key exchange on P-521, which rustls lacks. With TLS 1.2, a device with a key on P-521 presents
//! its certificate only to clients that offer this curve.

use aws_lc_rs::agreement::{
    ECDH_P521, EphemeralPrivateKey, PublicKey, UnparsedPublicKey, agree_ephemeral,
};
use aws_lc_rs::rand::SystemRandom;
use rustls::crypto::{ActiveKeyExchange, GetRandomFailed, SharedSecret, SupportedKxGroup};
use rustls::{Error, NamedGroup, PeerMisbehaved};

/// The first byte of an uncompressed point, the only form that TLS allows.
const UNCOMPRESSED: u8 = 4;

#[derive(Debug)]
pub(super) struct P521;

impl SupportedKxGroup for P521 {
    fn start(&self) -> Result<Box<dyn ActiveKeyExchange>, Error> {
        let private = EphemeralPrivateKey::generate(&ECDH_P521, &SystemRandom::new())
            .map_err(|_| GetRandomFailed)?;
        let public = private.compute_public_key().map_err(|_| GetRandomFailed)?;
        Ok(Box::new(Exchange { private, public }))
    }

    fn name(&self) -> NamedGroup {
        NamedGroup::secp521r1
    }
}

/// A key exchange in progress.
struct Exchange {
    private: EphemeralPrivateKey,
    public: PublicKey,
}

impl ActiveKeyExchange for Exchange {
    fn complete(self: Box<Self>, peer: &[u8]) -> Result<SharedSecret, Error> {
        let invalid = || Error::from(PeerMisbehaved::InvalidKeyShare);
        if peer.first() != Some(&UNCOMPRESSED) {
            return Err(invalid());
        }
        let peer = UnparsedPublicKey::new(&ECDH_P521, peer);
        agree_ephemeral(self.private, peer, invalid(), |secret| Ok(SharedSecret::from(secret)))
    }

    fn pub_key(&self) -> &[u8] {
        self.public.as_ref()
    }

    fn group(&self) -> NamedGroup {
        NamedGroup::secp521r1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_sides_compute_the_same_secret() {
        let [one, two] = [(); 2].map(|()| P521.start().unwrap());
        let publics = [&one, &two].map(|side| side.pub_key().to_vec());
        let [of_one, of_two] = publics.clone();
        let secrets = [one.complete(&of_two).unwrap(), two.complete(&of_one).unwrap()];
        assert_eq!(secrets[0].secret_bytes(), secrets[1].secret_bytes());
        assert_eq!(secrets[0].secret_bytes().len(), 66);
    }

    #[test]
    fn a_share_that_is_not_an_uncompressed_point_of_the_curve_is_refused() {
        let good = P521.start().unwrap().pub_key().to_vec();
        let mut off = good.clone();
        off[132] ^= 1;
        let compressed = [&[2 + (good[132] & 1)], &good[1..67]].concat();
        for share in [&[][..], &[4], &good[..132], &off, &compressed, &[0]] {
            let refused = P521.start().unwrap().complete(share).err();
            let invalid = Some(PeerMisbehaved::InvalidKeyShare.into());
            assert_eq!(refused, invalid, "{} bytes", share.len());
        }
    }
}
