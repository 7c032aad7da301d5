// The exact integral of a linear segment: emission c tau, with colour c and extinction tau both linear in
// distance [TetVol, section 4.2], [Moreland 2004].
//
// With a = tau_f D and b = tau_b D, m = (a + b) / 2, delta = (b - a) / 2: zeta = exp(-m) is the
// transmittance, Psi is the integral of exp(-m s + delta s (1 - s)) over s in [0, 1], and the emission is
// w_f c_f + w_b c_b with w_f = 1 - Psi and w_b = Psi - zeta.
//
// Psi = exp(-m / 2) Phi with Phi the integral of cosh(m u / 2) exp(delta (1 - u^2) / 4) over u in [0, 1],
// an entire function of m^2 and delta. With h = exp(-m / 2), q = 1 - h and p = Phi - 1 nothing cancels:
//     w_f = q - h p, w_b = h (p + q), zeta = h^2,
// and where m is at most LONG, p is a polynomial in both; |delta| is at most m. Beyond, with
// x = a / (2 sqrt |delta|) and y = b / (2 sqrt |delta|),
//     Psi = sqrt(pi) / (2 sqrt |delta|) (erfcx x - zeta erfcx y) where delta > 0,
//     Psi = 1 / sqrt |delta| (Dawson x - zeta Dawson y) where delta <= 0.
//
// Each polynomial is a minimax fit of the relative error of the weights (Lawson's algorithm, on float64
// values); the error stated beside it excludes rounding.

#include "lanes.h"

#define TINY 1e-30f // less counts as 0
#define SHORT 0.25f
#define LONG 4.0f
#define OPAQUE 80.0f // where exp(-m) counts as 0, above the denormals

// 1 - exp(-m) and exp(-m), the latter of m + `rest`, for m >= 0, each with a relative error of at most
// 1e-6: 2^-n (1 + e), e = exp(r) - 1 with r = n ln 2 - m in [-0.347, 0.347]; error of e 1.3e-8.
void attenuate(floats m, floats rest, floats *alpha, floats *zeta)
{
    const ints opaque = m > OPAQUE;
    const floats near = opaque ? OPAQUE : m;
    const ints n = to_ints(near * 1.44269504f + 0.5f);
    const floats whole = to_floats(n);
    // ln 2 in two parts: the product with the first is exact
    const floats r = (whole * 0.693359375f - near) - (whole * 2.12194440e-4f + rest);
    const floats e = r + r * r * ((((0.00138824899f * r + 0.00836669281f) * r + 0.0416672044f) * r +
                                   0.16666542f) * r + 0.49999997f);
    const floats power = as_floats((127 - n) << 23);
    *alpha = opaque ? 1.0f : (1.0f - power) - power * e;
    *zeta = opaque ? 0.0f : power + power * e;
}

// p for m <= SHORT, z = m^2: error of the weights 8.3e-8.
floats phi_short(floats z, floats delta)
{
    floats p = 6.61003069e-05f * delta + 0.00119164947f;
    p = p * delta + (0.000297651975f * z + 0.0166666787f);
    p = p * delta + (0.00416903989f * z + 0.166666642f);
    return p * delta + (0.000521049951f * z + 0.0416666605f) * z;
}

// p for m <= LONG: error of the weights 1.6e-7.
floats phi_middle(floats z, floats delta)
{
    floats p = 3.71374069e-12f * delta + 1.33179565e-10f;
    p = p * delta + (3.08957547e-11f * z + 3.81692811e-09f);
    p = p * delta + (1.0880985e-09f * z + 1.14297691e-07f);
    p = p * delta + ((1.17739263e-10f * z + 2.91392457e-08f) * z + 3.0047886e-06f);
    p = p * delta + ((3.9639767e-09f * z + 7.47525064e-07f) * z + 6.61589438e-05f);
    p = p * delta + (((3.05064612e-10f * z + 9.43341831e-08f) * z + 1.65281253e-05f) * z +
                     0.00119049905f);
    p = p * delta + (((8.52712745e-09f * z + 2.05852075e-06f) * z + 0.000297654013f) * z +
                     0.0166665912f);
    p = p * delta + ((((4.95881225e-10f * z + 1.72740698e-07f) * z + 3.71945243e-05f) * z +
                      0.00416669995f) * z + 0.166666642f);
    return p * delta + (((1.16676331e-08f * z + 3.08946551e-06f) * z + 0.000520878821f) * z +
                        0.0416666344f) * z;
}

// sqrt(pi) erfcx(x) / k for x = end / k >= 0, not both 0: a polynomial in t = 2.5 / (x + 2.5), times
// 1 / (end + 2.5 k); error 1.3e-7.
floats scaled_erfcx(floats end, floats k)
{
    const floats inverse = 1.0f / (end + 2.5f * k);
    const floats t = 2.5f * k * inverse;
    floats p = 0.222707048f * t - 0.810420573f;
    p = p * t + 0.749181747f;
    p = p * t - 0.0248044692f;
    p = p * t + 0.626684487f;
    p = p * t + 0.746835768f;
    p = p * t + 0.920978665f;
    p = p * t + 0.999972403f;
    p = p * t + 1.00000012f;
    return p * inverse;
}

// 2 Dawson(x) / k for x = end / k >= 0, k^2 = square, not both 0: a quotient of polynomials in t - 1/4,
// t = 4 / (x^2 + 4), times 2 end / (end^2 + 4 k^2). Error 1e-7 where x^2 > LONG; as much of Psi
// elsewhere, where it is multiplied by zeta.
floats scaled_dawson(floats end, floats square)
{
    const floats inverse = 1.0f / (end * end + 4.0f * square);
    const floats t = 4.0f * square * inverse - 0.25f;
    floats p = 114.458405f * t + 161.658447f;
    p = p * t + 98.164978f;
    p = p * t + 75.5452805f;
    p = p * t + 8.98620605f;
    p = p * t + 14.4805727f;
    p = p * t + 0.265689075f;
    p = p * t + 0.699020803f;
    floats q = 48.4506569f * t - 41.2121925f;
    q = q * t + 79.8252869f;
    q = q * t - 22.0071545f;
    q = q * t + 19.8067417f;
    q = q * t - 1.24882483f;
    q = q * t + 1.0f;
    return 2.0f * end * inverse * (p / q);
}

// Psi and zeta for m > LONG.
void psi_long(floats a, floats b, floats *psi, floats *zeta)
{
    const ints rising = b > a;
    const floats small = rising ? a : b, big = rising ? b : a;
    const floats sum = a + b;
    const floats lost = small - (sum - big); // by rounding the sum [Dekker 1971]
    floats alpha;
    attenuate(0.5f * sum, 0.5f * lost, &alpha, zeta);
    const floats square = 2.0f * (big - small); // k^2, k = 2 sqrt |delta|
    floats front = 0.0f, back = 0.0f;
    if (ANY(rising)) {
        const floats k = sqrt(square);
        front = scaled_erfcx(small, k);
        back = scaled_erfcx(big, k);
    }
    if (ANY(!rising)) {
        front = rising ? front : scaled_dawson(big, square);
        back = rising ? back : scaled_dawson(small, square);
    }
    *psi = front - *zeta * back;
}

// The weights of the colours at a segment's ends and its transmittance, each with a relative error of at
// most 1e-6, for a, b >= 0; values below TINY count as 0.
void segment_weights(floats a, floats b, floats *w_f, floats *w_b, floats *zeta)
{
    a = a < TINY ? 0.0f : a;
    b = b < TINY ? 0.0f : b;
    const floats m = 0.5f * (a + b), delta = 0.5f * (b - a);
    const floats z = m < 1e-15f ? 0.0f : m * m; // no denormals
    const floats t = 0.5f * m;
    // 1 - exp(-t) for t <= SHORT / 2: error 8e-11
    floats q = t * ((((0.00791072659f * t - 0.0416207425f) * t + 0.166664615f) * t - 0.49999997f) * t +
                    1.0f);
    floats h = 1.0f - q;
    floats p = phi_short(z, delta);
    const ints middle = m > SHORT;
    if (ANY(middle)) {
        floats alpha, rest;
        attenuate(t, 0.0f, &alpha, &rest);
        q = middle ? alpha : q;
        h = middle ? rest : h;
        p = middle ? phi_middle(z, delta) : p;
    }
    floats front = q - h * p, back = h * (p + q), transmittance = h * h;
    const ints lengthy = m > LONG;
    if (ANY(lengthy)) {
        floats psi, rest;
        psi_long(a, b, &psi, &rest);
        front = lengthy ? 1.0f - psi : front;
        back = lengthy ? psi - rest : back;
        transmittance = lengthy ? rest : transmittance;
    }
    *w_f = front;
    *w_b = back;
    *zeta = transmittance;
}
