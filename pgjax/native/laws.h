// Constitutive laws and return mappings of a group of particles: the formulas of
// `pgjax/models/strain.py`, `elasticity.py` and `plasticity.py`, which are the reference and have the
// derivatives.
//
// A matrix is nine vectors in rows. H = F - I.
#pragma once

#include <cstring>

#include "eigen.h"

namespace pgjax {

template <class V>
using NumberOf = std::decay_t<decltype(V{}[0])>;
template <class V>
using BitsOf = decltype(V{} < V{});  // integers as wide

// log 2 in two parts, the first with trailing zeros.
template <class T>
constexpr T kLog2[2] = {T(0.693147180369123816490), T(1.90821492927058770002e-10)};
template <>
constexpr float kLog2<float>[2] = {0.693145751953125f, 1.42860682030941723e-6f};

// log y for y > 0, given x = y - 1, which may be more accurate.
template <class V>
inline V log(V y, V x) {
  using T = NumberOf<V>;
  using I = BitsOf<V>;
  constexpr bool kSingle = sizeof(T) == 4;
  constexpr int kMantissa = kSingle ? 23 : 52, kBias = kSingle ? 127 : 1023;
  // y = 2^k m with m in [sqrt(1/2), sqrt(2)).
  const V root_half = V{} + T(0.70710678118654752440);
  I bits, half_bits;
  std::memcpy(&bits, &y, sizeof y);
  std::memcpy(&half_bits, &root_half, sizeof y);
  const I k = (bits - half_bits) >> kMantissa, power = (kBias - k) << kMantissa;
  V scale;
  std::memcpy(&scale, &power, sizeof y);
  const V z = k == 0 ? x : y * scale - 1;
  // log m = 2 artanh s.
  const V s = z / (z + 2), q = s * s;
  V sum = {};
  for (int n = kSingle ? 6 : 12; n >= 1; --n) sum = q * (sum + T(1) / T(2 * n + 1));
  const V whole = __builtin_convertvector(k, V);
  return whole * kLog2<T>[0] + (2 * s * (sum + 1) + whole * kLog2<T>[1]);
}

// exp(x) - 1, accurate near 0; |x| is cut at 80 (double: 700).
template <class V>
inline V expm1(V x) {
  using T = NumberOf<V>;
  using I = BitsOf<V>;
  constexpr bool kSingle = sizeof(T) == 4;
  constexpr int kMantissa = kSingle ? 23 : 52, kBias = kSingle ? 127 : 1023;
  const T limit = kSingle ? 80 : 700;
  x = x > limit ? V{} + limit : (x < -limit ? V{} - limit : x);
  // The nearest whole number, by adding what pushes the fraction out.
  const T shift = kSingle ? T(12582912) : T(6755399441055744);
  V k = x * T(1.44269504088896340736) + shift;
  k -= shift;
  const V r = (x - k * kLog2<T>[0]) - k * kLog2<T>[1];
  V sum = {};
  for (int n = kSingle ? 8 : 14; n >= 2; --n) sum = (sum + 1) * r * (T(1) / T(n));
  const V small = r * (sum + 1);
  const I power = (__builtin_convertvector(k, I) + kBias) << kMantissa;
  V two_k;
  std::memcpy(&two_k, &power, sizeof power);
  return two_k * small + (two_k - 1);
}

// B = F F^T - I = H + H^T + H H^T: 00, 11, 22, 01, 02, 12.
template <class V>
inline void left_strain(const V* h, V b[6]) {
  const auto entry = [&](int i, int j) {
    const V* x = h + 3 * i;
    const V* y = h + 3 * j;
    return x[j] + y[i] + (x[0] * y[0] + x[1] * y[1] + x[2] * y[2]);
  };
  b[0] = entry(0, 0), b[1] = entry(1, 1), b[2] = entry(2, 2);
  b[3] = entry(0, 1), b[4] = entry(0, 2), b[5] = entry(1, 2);
}

// J - 1 by the invariants of H.
template <class V>
inline V volume_change(const V* h) {
  const V trace = h[0] + h[4] + h[8];
  const V second = (h[0] * h[4] - h[1] * h[3]) + (h[0] * h[8] - h[2] * h[6]) +
                   (h[4] * h[8] - h[5] * h[7]);
  const V third = h[0] * (h[4] * h[8] - h[5] * h[7]) + h[1] * (h[5] * h[6] - h[3] * h[8]) +
                  h[2] * (h[3] * h[7] - h[4] * h[6]);
  return trace + second + third;
}

// |J| - 1, from J - 1.
template <class V>
inline V mirrored(V change) {
  return change < -1 ? -2 - change : change;
}

template <class V>
inline void put_symmetric(const V s[6], V* out) {
  out[0] = s[0], out[4] = s[1], out[8] = s[2];
  out[1] = out[3] = s[3], out[2] = out[6] = s[4], out[5] = out[7] = s[5];
}

// Q diag(values) Q^T, the columns of Q being the vectors.
template <class V>
inline void assemble(const V q[9], const V values[3], V s[6]) {
  const auto entry = [&](int i, int j) {
    const V* x = q + 3 * i;
    const V* y = q + 3 * j;
    return x[0] * y[0] * values[0] + x[1] * y[1] * values[1] + x[2] * y[2] * values[2];
  };
  s[0] = entry(0, 0), s[1] = entry(1, 1), s[2] = entry(2, 2);
  s[3] = entry(0, 1), s[4] = entry(0, 2), s[5] = entry(1, 2);
}

constexpr double kSmallestStretch = 1e-4, kSmallestVolumeRatio = 1e-2;

template <class V>
struct Stretches {
  V sigma[3], w[3], q[9];  // signed, largest first; w = sigma^2 - 1; directions in columns
};

// `principal_stretches` in strain.py.
template <class V>
inline Stretches<V> principal_stretches(const V b[6], V change) {
  const V zero = {}, one = zero + 1;
  Stretches<V> s;
  diagonalise(b, s.w, s.q);
  for (int i = 0; i < 3; ++i) s.sigma[i] = root(at_least(1 + s.w[i], zero));
  const V product = s.sigma[0] * s.sigma[1], J = 1 + change;
  const V from_J = J / (product > 0 ? product : one);
  const auto small = (s.sigma[2] < NumberOf<V>(0.3)) | (J < 0);
  s.sigma[2] = small ? from_J : s.sigma[2];
  s.w[2] = small ? from_J * from_J - 1 : s.w[2];
  return s;
}

// Hencky strains along the principal directions.
template <class V>
inline void log_stretches(const Stretches<V>& s, V e[3]) {
  using T = NumberOf<V>;
  const V least = V{} + T(kSmallestStretch);
  for (int i = 0; i < 3; ++i) {
    const V w = s.w[i], sigma = at_least(s.sigma[i] < 0 ? -s.sigma[i] : s.sigma[i], least);
    // Near 1 from w, which is exact there; far below from sigma.
    const auto near = w > T(-0.5);
    const V logarithm = log(near ? 1 + w : sigma, near ? w : sigma - 1);
    e[i] = near ? logarithm / 2 : logarithm;
  }
}

// tau = mu B + lam log J I. In: H, mu, lam. Out: tau, J - 1.
template <class V>
inline void neo_hookean(const V* in, V* out) {
  using T = NumberOf<V>;
  const V mu = in[9], lam = in[10], zero = {};
  V b[6];
  left_strain(in, b);
  const V change = volume_change(in), size = mirrored(change), J = 1 + size;
  // Continued by its tangent, as `log_volume` does.
  const T at = T(kSmallestVolumeRatio);
  const auto regular = J > at;
  const V inside = regular ? size : zero;
  const V log_J = regular ? log(1 + inside, inside) : T(std::log(at)) + (J - at) / at;
  for (int i = 0; i < 6; ++i) b[i] *= mu;
  for (int i = 0; i < 3; ++i) b[i] += lam * log_J;
  put_symmetric(b, out);
  out[9] = change;
}

// tau = 2 mu (B - (V - I)) + lam J (J - 1) I. In: H, mu, lam. Out: tau, J - 1.
template <class V>
inline void fixed_corotated(const V* in, V* out) {
  const V mu = in[9], lam = in[10], zero = {};
  V b[6], stretch[6], values[3];
  left_strain(in, b);
  const V change = volume_change(in);
  const auto s = principal_stretches(b, change);
  for (int i = 0; i < 3; ++i)
    values[i] = s.sigma[i] > 0 ? s.w[i] / (1 + at_least(s.sigma[i], zero)) : s.sigma[i] - 1;
  assemble(s.q, values, stretch);
  for (int i = 0; i < 6; ++i) b[i] = 2 * mu * (b[i] - stretch[i]);
  for (int i = 0; i < 3; ++i) b[i] += lam * (1 + change) * change;
  put_symmetric(b, out);
  out[9] = change;
}

// tau = 2 mu eps + lam tr(eps) I. In: H, mu, lam. Out: tau, J - 1, smallest stretch.
template <class V>
inline void stvk_hencky(const V* in, V* out) {
  const V mu = in[9], lam = in[10];
  V b[6], e[3];
  left_strain(in, b);
  const V change = volume_change(in);
  const auto s = principal_stretches(b, change);
  log_stretches(s, e);
  const V pressure = lam * (e[0] + e[1] + e[2]);
  const V values[3] = {2 * mu * e[0] + pressure, 2 * mu * e[1] + pressure,
                       2 * mu * e[2] + pressure};
  assemble(s.q, values, b);
  put_symmetric(b, out);
  out[9] = change, out[10] = s.sigma[2];
}

// H <- H + M + M H with M = exp(delta) - I along the principal directions.
template <class V>
inline void flow_along(const Stretches<V>& s, const V delta[3], const V* h, V* out) {
  const V values[3] = {expm1(delta[0]), expm1(delta[1]), expm1(delta[2])};
  V m[6];
  assemble(s.q, values, m);
  const V rows[9] = {m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2]};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const V* r = rows + 3 * i;
      out[3 * i + j] = h[3 * i + j] + (r[j] + (r[0] * h[j] + r[1] * h[3 + j] + r[2] * h[6 + j]));
    }
}

// The trial state of a return mapping along the principal directions, and where it is mapped to.
template <class V>
struct Trial {
  Stretches<V> s;
  V e[3];             // Hencky strains
  V n[3], norm, safe;  // direction and size of their deviator; the size, or 1 instead of 0
  V delta[3];         // the change of the strains
  BitsOf<V> upright, yields;
};
template <class V>
inline Trial<V> trial_state(const V* in) {
  const V zero = {}, one = zero + 1;
  Trial<V> t;
  V b[6];
  left_strain(in, b);
  const V change = volume_change(in);
  t.s = principal_stretches(b, change);
  log_stretches(t.s, t.e);
  const V mean = (t.e[0] + t.e[1] + t.e[2]) / 3;
  V square = zero;
  for (int i = 0; i < 3; ++i) square += (t.e[i] - mean) * (t.e[i] - mean);
  t.norm = root(square), t.safe = t.norm > 0 ? t.norm : one;
  for (int i = 0; i < 3; ++i) t.n[i] = (t.e[i] - mean) / t.safe;
  t.upright = change > -1;
  return t;
}

// Radial return. In: H, tau_Y, mu.
template <class V>
inline Trial<V> radial_return(const V* in) {
  const V limit = in[9] / (2 * in[10]), zero = {};
  Trial<V> t = trial_state(in);
  t.yields = (t.norm > limit) & t.upright;
  for (int i = 0; i < 3; ++i) t.delta[i] = t.yields ? (limit - t.norm) * t.n[i] : zero;
  return t;
}

// Return to the cone or its tip. In: H, alpha (3 lam + 2 mu)/(2 mu), cohesion, the volume gained
// before.
template <class V>
struct ConeTrial : Trial<V> {
  V trace;  // of the strain from the tip, the volume gained given back
  BitsOf<V> cone;
};
template <class V>
inline ConeTrial<V> cone_return(const V* in) {
  const V slope = in[9], apex = in[10], gained = in[11], zero = {};
  ConeTrial<V> t{trial_state(in), {}, {}};
  t.trace = t.e[0] + t.e[1] + t.e[2] + gained - 3 * apex;
  const V excess = t.norm + slope * t.trace;
  const auto tip = t.trace > 0;
  t.yields = (tip | (excess > 0)) & t.upright, t.cone = t.yields & ~tip;
  for (int i = 0; i < 3; ++i) {
    const V moved = t.e[i] + (gained / 3 - apex);
    const V flowed = (tip ? zero : moved - excess * t.n[i]) + apex - t.e[i];
    t.delta[i] = t.yields ? flowed : (t.upright ? gained / 3 : zero);
  }
  return t;
}

// Out: H, the plastic strain increment.
template <class V>
inline void von_mises(const V* in, V* out) {
  const auto t = radial_return(in);
  flow_along(t.s, t.delta, in, out);
  out[9] = t.yields ? t.norm - in[9] / (2 * in[10]) : V{};
}

// Out: H, the volume gained.
template <class V>
inline void drucker_prager(const V* in, V* out) {
  const V zero = {}, gained = in[11];
  const auto t = cone_return(in);
  flow_along(t.s, t.delta, in, out);
  const V left = gained - (t.delta[0] + t.delta[1] + t.delta[2]);
  out[9] = t.upright ? (t.yields ? left : zero) : gained;
}

}  // namespace pgjax
