/* Where points are, from the tables of a rig: the compiled half of implicam.tabulated; docs/decisions/0026.

   A plain C interface without headers of Python or libraries, loaded by ctypes, which releases the interpreter's lock.
   The work is in kernel_body.h, which is compiled twice on x86: for what every such processor has, and for AVX2 with
   FMA; which of them runs is asked of the processor, once a call. On ARM, eight floats are two NEON registers.

   SPDX-License-Identifier: Apache-2.0 */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

enum { KERNEL_VERSION = 1, MAX_STEPS = 8, MAX_RAY_PAIRS = 40, WIDTH = 8, BLOCK = 64 };

/* What the kernel says of a point. */
enum { MEASURED = 0, TOO_FEW_VIEWS = 1, LEFT_TO_EXACT = 2, CONTRADICTION = 3, DISAGREES = 4 /* for the moment */ };

/* Whether views are wrong: some are, and left out; no choice is clear; or the exact path has to say. */
enum { MENDED, NOT_CLEAR, UNSURE };

/* The tables of a rig; `RigTable` in rig_table.py fills it in, in this order. Lengths are in the working frame. */
typedef struct {
  int64_t cameras, cells[3], sight_cells;
  double low[3], per_length[3];    /* of the box; cells per length */
  const double *projections;       /* [camera][12] */
  const float *grid;               /* [x][y][z][camera][8]: remainder of u and v, variances uu, uv, vv */
  const uint8_t *marked;           /* [cell x][y][z][camera] where the table is not accurate; null for nowhere */
  const double *sight_frames;      /* [camera][4]: first u and v, cells per pixel along u and v */
  const float *sight;              /* [camera][v][u][8]: a near and a far point of the line of sight, pixels there */
  double min_p, disagree_p, agree_p, clearly_better;
  double step_sds;                 /* the last step in standard deviations */
  int64_t suspects_of_two;
  const float *ties;               /* [x][y][z][pair][4]: covariances of two cameras; null where they are independent */
  const float *through;            /* [x][y][z][camera][2][unknowns]: the same of a camera and unknowns of labels */
  int64_t unknowns;
} Map;

/* One view of a point. */
typedef struct {
  double u, v, variance;           /* variance: of its noise */
  int64_t camera;
} Seen;

/* What is known of it while it is asked which views are wrong. */
typedef struct {
  double near_point[3], across[6], across_near[3]; /* line of sight: I - d d^T, and that times the near point */
  double along[3], pixel[2];       /* from the near point, in lengths of the line; length of a pixel near and far */
  double weight;                   /* of the line, by the noise and the length of a pixel */
  double D[2][3], W[3];            /* slope, and inverse covariance uu, uv, vv at the last place */
  double WD[2][3], Wr[2];          /* r: residual */
  double distance;                 /* r^T W r; or from the line of sight, squared */
  double b[2], M[3];               /* W (r - D step), and the block of W - W D H^-1 D^T W */
  int64_t used;                    /* whether it takes part */
} View;

EXPORTED int64_t implicam_kernel_version(void) { return KERNEL_VERSION; }
EXPORTED int64_t implicam_workspace_bytes(int64_t cameras, int64_t unknowns) {
  const int64_t views = cameras * (int64_t)(sizeof(View) + BLOCK * sizeof(Seen));
  return views + 2 * cameras * (2 * cameras + 4 + unknowns) * (int64_t)sizeof(double);
}
EXPORTED int64_t implicam_map_bytes(void) { return (int64_t)sizeof(Map); }

/* Linkers of extension modules look for this on Windows; nobody imports it. */
EXPORTED void *PyInit__kernel(void) { return NULL; }

/* Probability of a chi-squared beyond x; the degrees of freedom are odd. */
static double survival(double x, int64_t degrees) {
  if (!(x > 0)) return 1.0;
  double sum = 0, term = sqrt(2 * x / 3.14159265358979323846) * exp(-x / 2);
  for (int64_t i = 1; i < degrees; i += 2) {
    sum += term;
    term *= x / (double)(i + 2);
  }
  sum += erfc(sqrt(x / 2));
  return sum < 1 ? sum : 1.0;
}

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#define NAME(x) x##_base
#include "kernel_body.h"
#undef NAME

#if (defined(__x86_64__) || defined(__i386__)) && defined(__GNUC__)
#define HAS_AVX2 1
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma")
#endif
#define NAME(x) x##_avx2
#define WIDE 1
#include "kernel_body.h"
#undef NAME
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif
#endif

/* 1 where the processor has AVX2 and FMA, and the code for them is there. */
EXPORTED int64_t implicam_has_avx2(void) {
#if defined(HAS_AVX2)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
  return 0;
#endif
}

/* Points from pixels. uv [n][camera][2], not finite where not seen; noise [n][camera], or of all points alike where
   noise_stride is 0; xyz [n][3], cov [n][9], p [n], share [n], code [n], left_out [n][camera]. Where the code is not
   MEASURED, numbers are NaN, but for p of a CONTRADICTION. tied [n][3][unknowns]: D^T S^-1 times the covariance with the
   unknowns of the labels, where there are any; before any labels are taken into account, as all numbers. workspace: implicam_workspace_bytes of it, for this call alone. simd: 0 for the code
   that every processor can run, or what implicam_has_avx2 says. */
EXPORTED void implicam_measure(const Map *map, int64_t n, const double *uv, const double *noise, int64_t noise_stride,
                               double *xyz, double *cov, double *p, double *share, int8_t *code, uint8_t *left_out,
                               double *tied, void *workspace, int64_t simd) {
#if defined(HAS_AVX2)
  if (simd) {
    measure_avx2(map, n, uv, noise, noise_stride, xyz, cov, p, share, code, left_out, tied, workspace);
    return;
  }
#endif
  (void)simd;
  measure_base(map, n, uv, noise, noise_stride, xyz, cov, p, share, code, left_out, tied, workspace);
}
