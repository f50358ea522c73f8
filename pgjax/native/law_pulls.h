// Derivatives in reverse mode of the laws and return mappings of `laws.h`: from the cotangents of
// what they make to those of what they take. They are those of the plain functions in Python, with
// the divided differences of spectral functions.
//
// An isotropic function is f(B) = Q diag(f_i) Q^T; along its eigenvectors the derivative of entry
// ij is the divided difference of f over the eigenvalues i and j times that of B.
#pragma once

#include <limits>

#include "laws.h"

namespace pgjax {

// Q^T S Q and Q G Q^T of symmetric matrices: 00, 11, 22, 01, 02, 12.
template <class V>
inline void into_basis(const V q[9], const V s[6], V g[6]) {
  const V full[9] = {s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]};
  V t[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      t[3 * i + j] = full[3 * i] * q[j] + full[3 * i + 1] * q[3 + j] + full[3 * i + 2] * q[6 + j];
  const auto entry = [&](int i, int j) {
    return q[i] * t[j] + q[3 + i] * t[3 + j] + q[6 + i] * t[6 + j];
  };
  g[0] = entry(0, 0), g[1] = entry(1, 1), g[2] = entry(2, 2);
  g[3] = entry(0, 1), g[4] = entry(0, 2), g[5] = entry(1, 2);
}
template <class V>
inline void out_of_basis(const V q[9], const V g[6], V s[6]) {
  V turned[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) turned[3 * i + j] = q[3 * j + i];
  into_basis(turned, g, s);
}

template <class V>
inline void symmetric_part(const V* a, V s[6]) {
  s[0] = a[0], s[1] = a[4], s[2] = a[8];
  s[3] = (a[1] + a[3]) / 2, s[4] = (a[2] + a[6]) / 2, s[5] = (a[5] + a[7]) / 2;
}
// A : B of two symmetric matrices.
template <class V>
inline V double_dot(const V a[6], const V b[6]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + 2 * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5]);
}

// out += 2 S F, the pull of S through B = F F^T - I.
template <class V>
inline void pull_strain(const V s[6], const V* h, V* out) {
  const V full[9] = {s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const V* r = full + 3 * i;
      out[3 * i + j] += 2 * (r[j] + (r[0] * h[j] + r[1] * h[3 + j] + r[2] * h[6 + j]));
    }
}
// out += c cof F, the pull of c through J.
template <class V>
inline void pull_volume(V c, const V* h, V* out) {
  const V f[9] = {h[0] + 1, h[1], h[2], h[3], h[4] + 1, h[5], h[6], h[7], h[8] + 1};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const V *a = f + 3 * ((i + 1) % 3), *b = f + 3 * ((i + 2) % 3);
      const int k = (j + 1) % 3, l = (j + 2) % 3;
      out[3 * i + j] += c * (a[k] * b[l] - a[l] * b[k]);
    }
}

// In: H, mu, lam, and the cotangent of tau. Out: those of H, mu, lam.
template <class V>
inline void pull_neo_hookean(const V* in, const V* bar, V* out) {
  using T = NumberOf<V>;
  const V mu = in[9], lam = in[10], zero = {};
  V b[6], s[6], scaled[6];
  left_strain(in, b);
  symmetric_part(bar, s);
  const V change = volume_change(in), size = mirrored(change), J = 1 + size;
  const V trace = s[0] + s[1] + s[2];
  const T at = T(kSmallestVolumeRatio);
  const auto regular = J > at;
  const V inside = regular ? size : zero;
  const V log_J = regular ? log(1 + inside, inside) : T(std::log(at)) + (J - at) / at;
  const V steep = regular ? 1 / (1 + inside) : zero + 1 / at;
  const V slope = change < -1 ? -steep : steep;
  for (int e = 0; e < 9; ++e) out[e] = zero;
  for (int e = 0; e < 6; ++e) scaled[e] = mu * s[e];
  pull_strain(scaled, in, out);
  pull_volume(lam * trace * slope, in, out);
  out[9] = double_dot(s, b), out[10] = trace * log_J;
}

template <class V>
inline void pull_fixed_corotated(const V* in, const V* bar, V* out) {
  using T = NumberOf<V>;
  const V mu = in[9], lam = in[10], zero = {};
  V b[6], s[6], g[6], stretch[6], values[3], turned[6];
  left_strain(in, b);
  symmetric_part(bar, s);
  const V change = volume_change(in), trace = s[0] + s[1] + s[2];
  const auto p = principal_stretches(b, change);
  for (int i = 0; i < 3; ++i)
    values[i] = p.sigma[i] > 0 ? p.w[i] / (1 + at_least(p.sigma[i], zero)) : p.sigma[i] - 1;
  assemble(p.q, values, stretch);
  // Divided differences of the square root: 1/(sigma_i + sigma_j).
  const V least = std::numeric_limits<T>::epsilon() * at_least(p.sigma[0], zero + T(1e-6));
  const auto divided = [&](int i, int j) {
    const V total = p.sigma[i] + p.sigma[j], size = total < 0 ? -total : total;
    return (total < 0 ? zero - 1 : zero + 1) / at_least(size, least);
  };
  into_basis(p.q, s, g);
  g[0] *= divided(0, 0), g[1] *= divided(1, 1), g[2] *= divided(2, 2);
  g[3] *= divided(0, 1), g[4] *= divided(0, 2), g[5] *= divided(1, 2);
  out_of_basis(p.q, g, turned);
  for (int e = 0; e < 9; ++e) out[e] = zero;
  for (int e = 0; e < 6; ++e) turned[e] = 2 * mu * (s[e] - turned[e]);
  pull_strain(turned, in, out);
  pull_volume(lam * trace * (2 * change + 1), in, out);
  for (int e = 0; e < 6; ++e) b[e] -= stretch[e];
  out[9] = 2 * double_dot(s, b), out[10] = trace * (1 + change) * change;
}

// Divided differences of the Hencky strain over w (`_log_divided` / 2 in strain.py).
template <class V>
inline void log_divided(const Stretches<V>& s, V k[6]) {
  using T = NumberOf<V>;
  const V zero = {}, one = zero + 1, floor = zero + T(kSmallestStretch);
  V square[3], w[3], kept[3], inside_square[3], slope[3];
  for (int i = 0; i < 3; ++i) {
    const V stretch = s.sigma[i] < 0 ? -s.sigma[i] : s.sigma[i];
    const V sigma = at_least(stretch, floor);
    const auto inside = stretch > floor;
    square[i] = sigma * sigma;
    w[i] = s.w[i];
    kept[i] = inside ? w[i] : square[i] - 1;
    inside_square[i] = inside ? square[i] : zero;
    slope[i] = inside ? one / square[i] : zero;
  }
  const auto entry = [&](int i, int j) {
    const auto both_small = (w[i] < T(-0.5)) & (w[j] < T(-0.5));
    const V change = both_small ? square[i] - square[j] : kept[i] - kept[j];
    const V gap = both_small ? inside_square[i] - inside_square[j] : w[i] - w[j];
    const V ratio = change / square[j];
    const auto near = (ratio < T(0.5)) & (ratio > T(-0.5));
    const V quotient = near ? one + ratio : square[i] / square[j];
    const V logarithm = log(quotient, near ? ratio : quotient - 1);
    return (gap == 0 ? slope[i] : logarithm / (gap == 0 ? one : gap)) / 2;
  };
  k[0] = slope[0] / 2, k[1] = slope[1] / 2, k[2] = slope[2] / 2;
  k[3] = entry(0, 1), k[4] = entry(0, 2), k[5] = entry(1, 2);
}

template <class V>
inline void pull_stvk_hencky(const V* in, const V* bar, V* out) {
  const V mu = in[9], lam = in[10], zero = {};
  V b[6], s[6], g[6], e[3], k[6], turned[6];
  left_strain(in, b);
  symmetric_part(bar, s);
  const auto p = principal_stretches(b, volume_change(in));
  log_stretches(p, e);
  log_divided(p, k);
  into_basis(p.q, s, g);
  const V trace = s[0] + s[1] + s[2], volume = e[0] + e[1] + e[2];
  out[9] = 2 * (g[0] * e[0] + g[1] * e[1] + g[2] * e[2]), out[10] = trace * volume;
  for (int i = 0; i < 6; ++i) g[i] = k[i] * (2 * mu * g[i] + (i < 3 ? lam * trace : zero));
  out_of_basis(p.q, g, turned);
  for (int i = 0; i < 9; ++i) out[i] = zero;
  pull_strain(turned, in, out);
}

// The pull of a flow H <- H + M F, M = exp(delta) - I: out = bar + M^T bar, and the cotangent of
// delta in the basis.
template <class V>
inline void pull_flow(const Stretches<V>& s, const V delta[3], const V* h, const V* bar, V* out,
                      V delta_bar[6]) {
  const V zero = {}, one = zero + 1;
  V values[3], m[6];
  for (int i = 0; i < 3; ++i) values[i] = expm1(delta[i]);
  assemble(s.q, values, m);
  const V rows[9] = {m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2]};
  V m_bar[9], symmetric[6];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const V* r = rows + 3 * i;
      out[3 * i + j] = bar[3 * i + j] + (r[0] * bar[j] + r[1] * bar[3 + j] + r[2] * bar[6 + j]);
      // bar F^T
      const V *x = bar + 3 * i, *y = h + 3 * j;
      m_bar[3 * i + j] = x[j] + (x[0] * y[0] + x[1] * y[1] + x[2] * y[2]);
    }
  symmetric_part(m_bar, symmetric);
  into_basis(s.q, symmetric, delta_bar);
  const auto divided = [&](int i, int j) {
    const V gap = delta[i] - delta[j];
    return (1 + values[j]) * (gap == 0 ? one : expm1(gap) / (gap == 0 ? one : gap));
  };
  delta_bar[0] *= 1 + values[0], delta_bar[1] *= 1 + values[1], delta_bar[2] *= 1 + values[2];
  delta_bar[3] *= divided(0, 1), delta_bar[4] *= divided(0, 2), delta_bar[5] *= divided(1, 2);
}

// The pull of a Hencky strain's cotangent, given in the basis.
template <class V>
inline void pull_hencky(const Stretches<V>& s, const V eps_bar[6], const V* h, V* out) {
  V k[6], g[6], turned[6];
  log_divided(s, k);
  for (int i = 0; i < 6; ++i) g[i] = k[i] * eps_bar[i];
  out_of_basis(s.q, g, turned);
  pull_strain(turned, h, out);
}

// In: H, tau_Y, mu, and the cotangents of H and of the increment. Out: those of H, tau_Y, mu.
template <class V>
inline void pull_von_mises(const V* in, const V* bar, V* out) {
  const V limit = in[9] / (2 * in[10]), zero = {};
  V delta_bar[6], eps_bar[6];
  const auto t = radial_return(in);
  const V* n = t.n;
  pull_flow(t.s, t.delta, in, bar, out, delta_bar);
  // delta = -dev eps + limit n, the increment |dev eps| - limit.
  const V along = n[0] * delta_bar[0] + n[1] * delta_bar[1] + n[2] * delta_bar[2];
  const V share = limit / t.safe, increment_bar = bar[9];
  for (int i = 0; i < 6; ++i) eps_bar[i] = (share - 1) * delta_bar[i];
  for (int i = 0; i < 3; ++i) eps_bar[i] += (increment_bar - share * along) * n[i];
  const V third = (eps_bar[0] + eps_bar[1] + eps_bar[2]) / 3;
  for (int i = 0; i < 3; ++i) eps_bar[i] -= third;
  for (int i = 0; i < 6; ++i) eps_bar[i] = t.yields ? eps_bar[i] : zero;
  const V limit_bar = t.yields ? along - increment_bar : zero;
  pull_hencky(t.s, eps_bar, in, out);
  for (int i = 0; i < 9; ++i) out[i] = t.yields ? out[i] : bar[i];
  out[9] = limit_bar / (2 * in[10]), out[10] = -limit_bar * limit / in[10];
  // An infinite yield stress is never reached, nor does it have a derivative.
  for (int i = 9; i < 11; ++i) out[i] = t.yields ? out[i] : zero;
}

// In: H, slope, apex, gained, and the cotangents of H and of what is gained; `correct`: whether the
// volume gained is given back. Out: those of H, slope, apex, gained.
template <class V>
inline void pull_drucker_prager(const V* in, const V* bar, V* out, bool correct) {
  const V slope = in[9], zero = {};
  V delta_bar[6], eps_bar[6];
  const auto t = cone_return(in);
  const V* n = t.n;
  const auto tip = t.yields & ~t.cone;
  pull_flow(t.s, t.delta, in, bar, out, delta_bar);
  // Gained <- gained - tr delta where the material yields, else 0.
  const V history_bar = correct ? bar[9] : zero;
  for (int i = 0; i < 3; ++i) delta_bar[i] -= t.yields ? history_bar : zero;
  const V along = n[0] * delta_bar[0] + n[1] * delta_bar[1] + n[2] * delta_bar[2];
  const V total = delta_bar[0] + delta_bar[1] + delta_bar[2];
  // On the cone delta = gained/3 - dev eps - slope tr n, tr = tr eps + gained - 3 apex; at the tip
  // it is apex - eps.
  const V share = t.cone ? slope * t.trace / t.safe : zero, trace_bar = t.cone ? -slope * along : zero;
  for (int i = 0; i < 6; ++i) eps_bar[i] = -(1 + share) * delta_bar[i];
  for (int i = 0; i < 3; ++i) eps_bar[i] += share * along * n[i] + (t.cone ? (1 + share) * total / 3 : zero) + trace_bar;
  for (int i = 0; i < 6; ++i) eps_bar[i] = t.yields ? eps_bar[i] : zero;
  pull_hencky(t.s, eps_bar, in, out);
  const V through_elastic = correct ? (t.upright & ~t.yields ? total / 3 : zero) : zero;
  out[9] = t.cone ? -t.trace * along : zero;
  out[10] = (tip ? total : zero) - 3 * trace_bar;
  out[11] = (t.cone ? total / 3 : through_elastic) + trace_bar;
  out[11] += correct ? (t.yields | ~t.upright ? history_bar : zero) : bar[9];
}

}  // namespace pgjax
