// Compiled once per instruction set, with the rules of arithmetic loosened so that the loops vectorize.
#include "blend.hpp"
#include "blend_backward.hpp"
#include "contribution.hpp"
#include "kernels.h"
#include "leave_one_out.hpp"

namespace SPLAT_VARIANT {
namespace {

template <class T>
Workspace<T>& as(void* workspace) { return *static_cast<Workspace<T>*>(workspace); }

template <class T>
PixelKernels kernels() {
  return {[](void* w, const View& v, bool gated, const Layers& image) { blend(as<T>(w), v, gated, image); },
          [](void* w, const View& v, const void* transmittance, const Layers& cotangents, int64_t rows, void* gates,
             const Gathered* gathered) {
            blend_backward(as<T>(w), v, static_cast<const T*>(transmittance), cotangents, rows, static_cast<T*>(gates),
                           gathered);
          },
          [](void* w, const View& v, int64_t rows, const Counters& out) {
            count_contributions(as<T>(w), v, rows, out);
          },
          [](void* w, const View& v, int64_t rows, const Backdrop& sky_image, const Changes& out) {
            remove_rows(as<T>(w), v, rows, sky_image, out);
          }};
}

}  // namespace

void fill_pixel_kernels(Kernels& k) { k.pixels[0] = kernels<float>(), k.pixels[1] = kernels<double>(); }

}  // namespace SPLAT_VARIANT
