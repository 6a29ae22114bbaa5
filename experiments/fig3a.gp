# ddq along a line of the training surface (top) and of another surface (bottom): mean, two standard deviations, truth.
set multiplot layout 2, 3 margins 0.06, 0.99, 0.17, 0.92 spacing 0.07, 0.16
set grid lc rgb '#eeeeee'
set xrange [-6:6]
band = '#9ecae1'
do for [s in 'same other'] {
  file = dir . '/fig3a_' . s . '_surface.csv'
  set object 1 rectangle from -2, graph 0 to 2, graph 1 behind fc rgb '#f2f2f2' fs solid noborder
  if (s eq 'other') { band = '#fee391'; set xlabel 'q1 [m]' }
  do for [j=1:3] {
    a = sprintf('ddq%d', j)
    # one key for all
    if (s eq 'other' && j == 2) { set key at screen 0.5, 0.04 center horizontal samplen 3 } else { unset key }
    set ylabel sprintf('ddq%d [m/s²]', j) offset 0.5
    if (j == 2) { set title (s eq 'same' ? 'training surface (data within the grey band)' : 'another surface, no datum on it') } else { unset title }
    plot file using 'q1':(column(a) - 2*column(a.'_std')):(column(a) + 2*column(a.'_std')) with filledcurves fs solid 0.6 noborder lc rgb band title '± 2 std', \
         file using 'q1':(column(a.'_truth')) with lines lw 3 lc rgb '#bbbbbb' title 'truth', \
         file using 'q1':(column(a)) with lines lw 1.5 lc rgb '#08306b' dt 2 title 'GP²'
  }
}
unset multiplot
