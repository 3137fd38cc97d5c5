// From a Gaussian in the world to a splat on the screen. ops/reference states the same formulas. V is a register of
// rows: nothing branches, a row that is culled is computed all the same and its lane of the mask is 0.
#pragma once
#include "harmonics.hpp"
#include "shutter.hpp"
#include "workspace.hpp"

namespace SPLAT_VARIANT {

constexpr double COMPENSATION_FLOOR = 2.5e-5;     // least det / det_blurred of the antialias compensation
constexpr double LEAST_OPACITY = 0x1p-126;        // below it log2 and its power of two are no inverses in float
constexpr double DETERMINANT_MIN = 1e-12;         // px^4; only without eps2d: thinner splats touch no pixel center
constexpr double LOG2_SCALE = 0.84932180028801907;  // sqrt(log2(e) / 2)
constexpr double TWO_LN2 = 1.3862943611198906;

struct Nothing {};

// What an image is taken through; a shutter reads rows or columns. Without a part, nothing of it is compiled in.
template <bool WITH_LENS, bool WITH_SHUTTER, bool OVER_COLUMNS = false>
struct Effects {
  static constexpr bool LENS = WITH_LENS, SHUTTER = WITH_SHUTTER, COLUMNS = OVER_COLUMNS;
  template <class V>
  using Model = std::conditional_t<LENS, Distorted<V>, Pinhole<V>>;
  template <class V>
  using Row = std::conditional_t<SHUTTER, MovingRow<V>, RowValues<V>>;
  template <class V>
  using Moves = std::conditional_t<SHUTTER, Motion<V, LENS, COLUMNS>, Nothing>;
};

// The covariance C = F F^T + eps2d I of a footprint, and its determinant.
template <class V, int K>
struct Covariance {
  V xx, xy, yy, determinant, bare_determinant;

  template <class T>
  Covariance(const Camera<T>& camera, const Footprint<V, K>& f) : xx{}, xy{}, yy{}, bare_determinant{} {
    for (int i = 0; i < K; ++i) {
      xx += f.factor_x[i] * f.factor_x[i], yy += f.factor_y[i] * f.factor_y[i], xy += f.factor_x[i] * f.factor_y[i];
      // Cauchy-Binet: a sum of squares, so needles lose no digits and the determinant is never negative.
      for (int j = 0; j < i; ++j) {
        const V minor = f.factor_x[i] * f.factor_y[j] - f.factor_x[j] * f.factor_y[i];
        bare_determinant += minor * minor;
      }
    }
    determinant = bare_determinant + camera.eps2d * (xx + yy) + camera.eps2d * camera.eps2d;
    xx += camera.eps2d, yy += camera.eps2d;
  }
};

// All between the parameters of a row and its splat that backward needs again.
template <class E, class V>
struct Projection {
  using T = Scalar<V>;
  using Model = typename E::template Model<V>;
  static constexpr int K = Model::COLUMNS;
  Placement<V> placement;
  Model model;
  typename E::template Moves<V> motion;
  Footprint<V, K> footprint;
  Index<V> seen;  // in front of the camera, and shown by lens and shutter

  Projection(const Camera<T>& camera, const typename E::template Row<V>& row) : placement(place(camera, row)) {
    footprint = model.forward(camera, placement);
    seen = placement.mean.z > camera.near_plane;
    if constexpr (E::LENS) seen = seen && model.sees(camera, placement);
    if constexpr (E::SHUTTER) {
      motion = Motion<V, E::LENS, E::COLUMNS>(camera, placement, row.displacement);
      seen = seen && read_out(camera, motion, footprint) >= T(SLOWEST_READOUT);
    }
  }
};

template <class T, class V, int K>
inline V compensation(const Camera<T>& camera, const Covariance<V, K>& c) {
  if (!camera.antialias) return V{} + T(1);
  const V ratio = c.bare_determinant / c.determinant, floor = V{} + T(COMPENSATION_FLOOR);
  return root(ratio > floor ? ratio : floor);
}

// Color before the clamp at zero; also the unit direction, the distance and the basis for backward.
template <class V>
struct ViewColor {
  Vector<V> direction, raw;
  V distance, values[16];
};

template <class T, class V>
inline ViewColor<V> view_color(const Camera<T>& camera, const Vector<V>& in_camera, const V* sh, int64_t terms) {
  ViewColor<V> c;
  const Vector<V> ray = transposed(camera.rotation, in_camera);
  c.distance = root(dot(ray, ray));
  c.direction = (1 / c.distance) * ray;
  basis(c.direction, terms, c.values);
  const V middle = V{} + T(0.5);
  c.raw = {middle, middle, middle};
  for (int64_t k = 0; k < terms; ++k) c.raw = c.raw + c.values[k] * Vector<V>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]};
  return c;
}

// First and last index whose pixel center lies within [center - half, center + half], cut to [0, size); limited first,
// since the box of a giant does not fit an integer.
template <class T, class V>
inline void pixel_span(const V& center, const V& half, T size, Index<V>& first, Index<V>& last) {
  first = ceiling(limited(center - half - T(0.5), T(0), size));
  last = floored(limited(center + half - T(0.5), T(-1), size - 1));
}

// Where a splat ends: o exp(-q/2) >= alpha_min needs q <= 2 ln(o / alpha_min), a box of b deviations q <= b^2. Fills
// that as an exponent, and the box around the ellipse.
template <class T, class V, int K>
inline void bound(const Camera<T>& camera, const Covariance<V, K>& c, const V& opacity, Splat<V>& s) {
  s.log2_opacity = log2_positive<T>(opacity);
  s.least_exponent = V{} + camera.log2_alpha_min;
  V reach = V{} + camera.max_sigma_squared;
  if (camera.alpha_min > 0) reach = positive_part(T(TWO_LN2) * log2_positive<T>(opacity / camera.alpha_min));
  if (camera.max_sigma_squared <= std::numeric_limits<T>::max()) {
    const V end = s.log2_opacity - camera.max_sigma_squared / T(TWO_LN2), box = V{} + camera.max_sigma_squared;
    const auto boxed = box <= reach && end > s.least_exponent;
    s.least_exponent = boxed ? end : s.least_exponent;
    reach = box < reach ? box : reach;
  }
  if (camera.every_tile) reach = V{} + std::numeric_limits<T>::infinity();  // only of the box: the exponent stays
  s.half_x = root(reach * c.xx), s.half_y = root(reach * c.yy);
}

// Fills `s` but for its color; answers which rows can touch a pixel. Comparisons are written so that NaN culls.
template <class T, class E, class V>
inline Index<V> project(const Camera<T>& camera, const RowValues<V>& row, const Projection<E, V>& p, Splat<V>& s) {
  const Covariance<V, Projection<E, V>::K> c(camera, p.footprint);
  const V opacity = row.opacity * compensation(camera, c);
  bound(camera, c, opacity, s);
  s.x = p.footprint.x, s.y = p.footprint.y, s.depth = p.placement.mean.z;
  const V box_x = s.half_x + T(BOX_MARGIN), box_y = s.half_y + T(BOX_MARGIN);
  pixel_span(s.y, box_y + T(1e-5) * s.half_y, camera.height, s.first_row, s.last_row);
  const T scale = T(LOG2_SCALE);
  const V deviation_y = root(c.yy);
  s.l11 = scale * root(c.yy / c.determinant);
  s.l21 = -scale * c.xy / (deviation_y * root(c.determinant));
  s.l22 = scale / deviation_y;
  return p.seen && opacity >= T(LEAST_OPACITY) && c.determinant >= T(DETERMINANT_MIN) &&
         c.determinant <= std::numeric_limits<T>::max() &&
         dot(p.placement.mean, p.placement.mean) <= std::numeric_limits<T>::max() && opacity >= camera.alpha_min &&
         s.x + box_x >= T(0.5) && s.x - box_x <= camera.width - T(0.5) && s.y + box_y >= T(0.5) &&
         s.y - box_y <= camera.height - T(0.5);
}

}  // namespace SPLAT_VARIANT
